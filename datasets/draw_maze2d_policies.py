"""Draw the target policies of maze2d-umaze: datasets/maze2d-umaze/policies.png, one panel a policy.

python datasets/draw_maze2d_policies.py --episodes 20
"""

from __future__ import annotations

import argparse
from pathlib import Path

from matplotlib.figure import Figure

from oat_gym import domains, plots
from oat_gym.domains.maze2d_env import HORIZON, open_mazes
from oat_gym.domains.maze2d_layout import UMAZE
from oat_gym.domains.rollout import Recording, roll_out


def draw(path: Path, *, episodes: int) -> None:
    """Write the picture: trajectories of every policy from the same starts to the same goals."""
    found = domains.truth("maze2d-umaze")
    figure = Figure(figsize=(8.0, 5.6), dpi=90, layout="constrained")
    panels = figure.subplots(3, 4, sharex=True, sharey=True).ravel()
    with open_mazes(episodes) as envs:
        for axes, (name, policy) in zip(panels, domains.policies("maze2d-umaze").items(), strict=False):
            made = roll_out(envs, policy, seeds=range(episodes), horizon=HORIZON, record=Recording())
            walks = [episode.observations["achieved_goal"] for episode in made.episodes]  # type: ignore[index]
            plots.trajectories(axes, walks, maze=UMAZE.walls(), color=plots.SET_COLORS[0])
            axes.set_title(f"{name}: {found.values[name]:.3f}", fontsize=9)
    for axes in panels:
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": None})


def main() -> None:
    """Read the command line and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "maze2d-umaze" / "policies.png")
    options = parser.parse_args()
    if options.episodes < 1:
        parser.error("--episodes must be at least 1")
    draw(options.out, episodes=options.episodes)


if __name__ == "__main__":
    main()
