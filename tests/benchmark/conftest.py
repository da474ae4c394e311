"""What tests of tables and of the page share."""

import pytest

from oat_gym.benchmark.analysis import Analysis
from tests.benchmark.known import results_of


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    """One dataset whose true values are known and one of which nobody knows them."""
    return Analysis(results_of({"adroit-door-human": True, "logs": False}))
