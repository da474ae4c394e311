from collections.abc import Callable

import minari
import numpy as np
import pytest

from oat_gym import OAT, AugmentedDataset
from oat_gym.errors import InvalidDataError
from oat_gym.report import Spread, summarize


def test_real_and_synthetic_episodes_are_told_apart(walk_dataset: minari.MinariDataset, tiny_oat: OAT) -> None:
    data = AugmentedDataset(walk_dataset, tiny_oat, factor=2)
    summary = summarize(data)
    assert (summary.real.episodes, summary.synthetic.episodes) == (12, 12)
    assert summary.real.steps == summary.synthetic.steps == walk_dataset.total_steps
    assert summary.real.generated_steps == 0
    assert summary.synthetic.generated_steps == sum(data.provenance(i).mask.sum() for i in range(12, 24))
    assert summary.real.entry_seams is None
    assert 0 < summary.synthetic.entry_seams.low <= summary.synthetic.exit_seams.high
    returns = [episode.rewards.sum() for episode in walk_dataset]
    assert summary.real.returns.median == pytest.approx(np.median(returns))
    saved = data.save("test/saved-v0")
    assert summarize(saved).synthetic == summary.synthetic


def test_a_plain_dataset_is_all_real(make_dataset: Callable[..., minari.MinariDataset]) -> None:
    summary = summarize(make_dataset([3, 7, 1]))
    assert summary.synthetic is None
    assert summary.real.lengths == Spread(1, 2, 3, 5, 7)
    with pytest.raises(InvalidDataError, match="no episodes"):
        summarize(make_dataset([3], dataset_id="test/other-v0").filter_episodes(lambda episode: False))
