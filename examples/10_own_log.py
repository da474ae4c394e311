"""Your own table of decisions: a dataset of it, more episodes, and what other policies would have earned.

Run it with `python examples/10_own_log.py`; it works in a temporary folder. The table here is made up: a tutor that
gives hints to students at random.
"""

import os
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from gymnasium import spaces

import oat_gym
from oat_gym import ope
from oat_gym.generation import BehaviorConfig, VAEMDPConfig
from oat_gym.io.tables import episodes_from_table
from oat_gym.io.writing import DatasetCard, dataset_from_episodes


def made_up_log(students: int, decisions: int, seed: int) -> pd.DataFrame:
    """Return a row a decision; a hint (1) helps those who know little and costs 0.02, time goes on for everybody."""
    rng = np.random.default_rng(seed)
    rows = []
    for student in range(students):
        skill = rng.uniform(0.0, 0.5)
        for place in range(decisions):
            hint = int(rng.random() < 0.4)
            gain = (0.15 * (1 - skill) if hint else 0.05) * rng.uniform(0.5, 1.5)
            row = {"student": student, "place": place, "minute": 5.0 * place, "skill": skill}
            row |= {"tired": place / decisions, "hint": hint, "p_taken": 0.4 if hint else 0.6}
            rows.append(row | {"reward": gain - 0.02 * hint})
            skill = min(skill + gain, 1.0)
    return pd.DataFrame(rows)


def main() -> None:
    """Go from the table to estimates."""
    log = made_up_log(students=60, decisions=12, seed=0)
    columns = {"episode": "student", "order": "place", "observations": ["skill", "tired"], "action": "hint"}
    try:
        episodes_from_table(log.drop(index=5), **columns, reward="reward")
    except oat_gym.errors.InvalidDataError as error:
        print("A lost row is found:", error)

    episodes = episodes_from_table(log, **columns, reward="reward", time="minute", propensity="p_taken")
    real = dataset_from_episodes(
        episodes,
        directory=Path(os.environ["OAT_GYM_CACHE"]) / "log",
        card=DatasetCard(dataset_id="example/own-log-v0", description="a made-up log of hints"),
        observation_space=spaces.Box(0.0, 1.0, (2,), np.float64),
        action_space=spaces.Discrete(2),
    )
    print(real.total_episodes, "episodes,", real.total_steps, "steps; infos:", sorted(real[0].infos))

    method = oat_gym.OAT(
        mining=oat_gym.MiningConfig(n_clusters=3, length=4, switch_penalty=5.0),  # episodes of 12: W = 20 is too long
        model=VAEMDPConfig(max_updates=100),
        behavior=BehaviorConfig(max_updates=100),
    )
    data = oat_gym.AugmentedDataset(real, method, factor=3, seed=0)
    best = data.mining.sets[0]
    print(f"{len(data)} episodes; the set that was mined is in {best.support} of {len(real)}")

    hints = spaces.Discrete(2)
    early = ope.FunctionPolicy(lambda state: int(state[0] < 0.5), action_space=hints)
    policies = {"uniform": ope.UniformPolicy(hints), "hint early": ope.EpsilonGreedyPolicy(early, hints, epsilon=0.1)}
    estimators = [ope.ImportanceSampling(), ope.FQE(approximation="linear", degree=2)]
    print(ope.evaluate(data, policies, estimators, gamma=0.9, seeds=1, behavior="logged"))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["OAT_GYM_CACHE"] = folder
        main()
