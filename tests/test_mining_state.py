import numpy as np

from oat_gym.mining import MiningConfig, mine
from oat_gym.mining.state import mining_from_state, mining_to_state


def test_a_result_comes_back_equal() -> None:
    rng = np.random.default_rng(0)
    series = [np.concatenate([rng.normal(0, 1, (n, 2)), rng.normal(5, 1, (n, 2))]) for n in (12, 15, 9)]
    config = MiningConfig(n_clusters="auto", candidates=(2, 3), length=8, top=2, switch_penalty=5.0)
    result = mine(series, config=config, rng=rng)
    arrays, value = mining_to_state(result)
    again = mining_from_state(arrays, value)
    assert repr(again) == repr(result)
    assert again.criterion_scores == result.criterion_scores
    assert again.support_curve == result.support_curve
    assert [pst.labels for pst in again.sets] == [pst.labels for pst in result.sets]
    for left, right in zip(again.labels, result.labels, strict=True):
        np.testing.assert_array_equal(left, right)
    for left, right in zip(again.sets, result.sets, strict=True):
        np.testing.assert_array_equal(left.occurrences, right.occurrences)
        np.testing.assert_array_equal(left.all_occurrences, right.all_occurrences)
