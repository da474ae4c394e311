"""Several methods on one dataset, one of your own among them, and how like real data what they make is.

Run it with `python examples/08_methods.py`; it works in a temporary folder.
"""

import dataclasses
import os
import tempfile

import numpy as np
from minari import EpisodeData

from oat_gym import AugmentedDataset, Compose, Function, Jittering, Mixture, Permutation, Scaling, domains, metrics
from oat_gym.checks import ChecksFailed, check_augmenter


def calmer(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    """An augmenter of one's own: all actions a little smaller."""
    episode.actions[:] *= rng.uniform(0.8, 1.0)
    return episode


def careless(episode: EpisodeData, rng: np.random.Generator) -> EpisodeData:
    """One that breaks the contract: its numbers do not come from `rng`."""
    episode.rewards[:] += np.random.normal(size=len(episode.rewards))  # noqa: NPY002
    return episode


def main() -> None:
    """Compare, look at one episode, and check two augmenters."""
    real = domains.load("maze2d-umaze").filter_episodes(lambda episode: episode.id < 30)
    methods = {
        "jittering": Jittering(),
        "both": Compose((Scaling(), Jittering())),
        "either": Mixture((Permutation(), Scaling()), shares=(2.0, 1.0)),
        "calmer": Function(calmer),
    }
    print("one-step dynamics error, real data = 1, and distance of the distributions (real halves in brackets)")
    for row in metrics.compare(real, methods, factor=2, limit=500):
        if row.fidelity is None:
            print(row.name, row.reason)
            continue
        dynamics, sliced = row.fidelity.score("dynamics"), row.fidelity.score("sliced")
        print(f"{row.name:<10} {dynamics.value:.2f}  {sliced.value:.3f} ({sliced.reference:.3f})")

    data = AugmentedDataset(real, methods["either"], factor=2, seed=0)
    print(f"episode 30 is a variation of episode {data.provenance(30).source}: {len(data[30].rewards)} steps")

    print(str(check_augmenter(Jittering())).splitlines()[0])
    try:
        check_augmenter(Function(careless))
    except ChecksFailed as failed:
        print("careless:", ", ".join(name for name, _ in failed.report.failed))
    print(dataclasses.replace(Jittering(), sigma=0.1))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["OAT_GYM_CACHE"] = folder
        main()
