"""Scaling: one factor from N(1, sigma) for an episode and channel, about the channel's mean over the data."""

import minari
import numpy as np

from oat_gym import AugmentedDataset, Scaling


def factors(made: minari.EpisodeData, real: list[minari.EpisodeData], name: str, i: int) -> np.ndarray:
    """Return the least-squares factor of each channel of a synthetic episode, checked against every value."""
    width = 1 if name == "rewards" else 2
    rows = [getattr(real[i], name).reshape(-1, width).astype(float) for i in range(len(real))]
    mean = np.concatenate(rows).mean(axis=0)
    recorded = rows[i] - mean
    changed = getattr(made, name).reshape(-1, width) - mean
    factor = (changed * recorded).sum(axis=0) / (recorded**2).sum(axis=0)
    np.testing.assert_allclose(changed, factor * recorded, atol=1e-5)  # all T+1 states, so s and s' alike
    return factor


def test_factors_are_normal_about_one_and_differ_by_episode_and_channel(walk_dataset: minari.MinariDataset) -> None:
    real = list(walk_dataset)
    # actions of the walks come within their bounds even when scaled, so that nothing is clipped
    data = AugmentedDataset(walk_dataset, Scaling(sigma=0.1), factor=11, seed=0)
    found = np.array(
        [
            np.concatenate(
                [factors(data[number], real, name, number % 12) for name in ("observations", "actions", "rewards")]
            )
            for number in range(12, 132)
        ]
    )
    error = 0.1 / np.sqrt(len(found))
    assert found.shape == (120, 5)
    assert (np.abs(found.mean(axis=0) - 1) < 4 * error).all()
    assert (np.abs(found.std(axis=0) - 0.1) < 4 * error).all()
    assert np.abs(np.corrcoef(found.T) - np.eye(5)).max() < 0.3
