"""Roll out the target policies of tutor-sim and store their true values: datasets/truth/tutor-sim.json.

    python datasets/truth_tutor_sim.py --episodes 20000

Every policy meets the same students (seed 2; the logs have 0 and 1).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from oat_gym.domains import tutor_sim
from oat_gym.domains.truth import stored_truth, write_truth

COMMAND = "python datasets/truth_tutor_sim.py --episodes {episodes}"
SEED = 2
NOTE = "The normalised learning gain, earned in the last of 12 steps. Networks take 5% of their actions at random."


def make_truth(*, episodes: int, out: Path) -> None:
    """Write the truth file."""
    rewards = {
        name: tutor_sim.roll_outs(policy, episodes=episodes, seed=SEED).rewards
        for name, policy in tutor_sim.policies().items()
    }
    for name, earned in rewards.items():
        print(f"{name}: mean gain {earned[:, -1].mean():.4f}")
    command = COMMAND.format(episodes=episodes)
    write_truth(out / "tutor-sim.json", stored_truth(rewards, horizon=tutor_sim.HORIZON, command=command, note=NOTE))


def main() -> None:
    """Read the command line and make the truth file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "truth")
    options = parser.parse_args()
    if options.episodes < 2:
        parser.error(f"--episodes must be at least 2, got {options.episodes}")
    make_truth(episodes=options.episodes, out=options.out)


if __name__ == "__main__":
    main()
