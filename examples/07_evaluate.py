"""What would other policies have earned? Estimates, their errors, and how they compare with the truth.

Run it with `python examples/07_evaluate.py`; it works in a temporary folder.
"""

import os
import tempfile
import warnings

import minari
import numpy as np
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

import oat_gym
from oat_gym import ope

GAMMA = 0.9
ON = np.array([0.2, 0.8])  # three rooms in a row: probability that action 0 or 1 leads to the next one
BEHAVIOR = np.full((4, 2), 0.5)


def record(rng: np.random.Generator) -> EpisodeBuffer:
    """Walk to the end under the behaviour policy: action 1 costs 0.1, the way out is worth 1."""
    states, actions, rewards = [0], [], []
    while states[-1] < 3:
        actions.append(int(rng.random() < BEHAVIOR[states[-1], 1]))
        states.append(states[-1] + int(rng.random() < ON[actions[-1]]))
        rewards.append(float(states[-1] == 3) - 0.1 * actions[-1])
    last = np.arange(len(actions)) == len(actions) - 1
    return EpisodeBuffer(
        observations=np.array(states),
        actions=np.array(actions, dtype=int),
        rewards=np.array(rewards),
        terminations=last,
        truncations=np.zeros(len(actions), dtype=bool),
    )


def true_value(hurry: float) -> float:
    """Return the value of action 1 with a fixed probability, from the last room backwards."""
    onward, value = ON @ np.array([1 - hurry, hurry]), 1.0 / GAMMA
    for _ in range(3):
        value = (GAMMA * onward * value - 0.1 * hurry) / (1 - GAMMA * (1 - onward))
    return float(value)


def main() -> None:
    """Estimate three policies from 80 episodes, twice: without and with augmented episodes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Minari asks for metadata that an example does not need
        real = minari.create_dataset_from_buffers(
            "example/rooms-v0",
            [record(np.random.default_rng(seed)) for seed in range(80)],
            observation_space=spaces.Discrete(4),
            action_space=spaces.Discrete(2),
        )
    hurry = {"slow": 0.3, "as recorded": 0.5, "fast": 0.7}
    policies = {name: ope.TabularPolicy(np.tile([1 - p, p], (4, 1))) for name, p in hurry.items()}
    truth = {name: true_value(p) for name, p in hurry.items()}

    estimators = [ope.ImportanceSampling(), ope.DoublyRobust()]
    known = ope.TabularPolicy(BEHAVIOR)  # behavior="clone" would estimate it
    result = ope.evaluate(real, policies, estimators, gamma=GAMMA, seeds=1, behavior=known)
    print(result)  # result.rows has the diagnostics too
    print({name: round(value, 3) for name, value in truth.items()}, "is the truth")
    for row in result.compare(truth):
        print(row["estimator"], {name: round(row[name], 3) for name in ("mae", "rank_correlation", "regret_at_1")})

    data = oat_gym.AugmentedDataset(real, oat_gym.Function(lambda episode, rng: episode), factor=3, seed=0)
    paired = ope.evaluate(data, policies, estimators, gamma=GAMMA, seeds=1, behavior=known, paired=True)
    for row in paired.differences:  # copies of the data change nothing, and pretend to no precision
        print(row["policy"], row["estimator"], f"{row['difference']:+.4f} ({row['low']:+.4f} to {row['high']:+.4f})")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        main()
