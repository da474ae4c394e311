"""Compute the true values of sepsis-sim's target policies by roll-outs, and store them.

    python datasets/truth_sepsis_sim.py --episodes 2000 --out datasets/truth/sepsis-sim.json

Every policy meets the same patients. The same seed and library versions give the same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from oat_gym.domains import sepsis_sim
from oat_gym.domains.rollout import roll_out
from oat_gym.domains.truth import stored_truth, write_truth

FIRST_SEED = 2_000_000
NOTE = (
    "Discounted return a policy earns in oat_gym/Sepsis-v0 from admission, in at most 1160 events; rewards are those "
    "of the stages of sepsis."
)


def main() -> None:
    """Read the command line, roll out and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "truth" / "sepsis-sim.json")
    options = parser.parse_args()
    if options.episodes < 2:
        parser.error(f"--episodes must be at least 2, got {options.episodes}")
    ward, seeds = sepsis_sim.open_ward(500), range(FIRST_SEED, FIRST_SEED + options.episodes)
    rewards = {
        name: roll_out(ward, policy, seeds=seeds, horizon=sepsis_sim.HORIZON).rewards
        for name, policy in sepsis_sim.policies().items()
    }
    command = f"python datasets/truth_sepsis_sim.py --episodes {options.episodes}"
    write_truth(options.out, stored_truth(rewards, horizon=sepsis_sim.HORIZON, command=command, note=NOTE))
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
