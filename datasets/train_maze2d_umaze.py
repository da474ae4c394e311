"""Train the target policies of maze2d-umaze: datasets/maze2d-umaze/policies/umaze-0 ... umaze-10.

    python datasets/train_maze2d_umaze.py --seed 0 --out datasets/maze2d-umaze/policies

A tanh network of two hidden layers of 64 learns the actions of the planner that made the data (without its noise and
without its memory) by least squares, on states of noisy walks and on uniformly random ones. The eleven policies are
snapshots after `SNAPSHOTS` updates, chosen so that their values lie well apart. The same seed and library versions give
the same bytes.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from oat_gym._rng import derive, torch_generator
from oat_gym.domains.maze2d_env import HORIZON, open_mazes
from oat_gym.domains.maze2d_layout import UMAZE
from oat_gym.domains.maze2d_planner import Planner, memoryless_actions
from oat_gym.domains.maze2d_policies import ACTION_SPACE, NAMES, features, save_layers
from oat_gym.domains.rollout import Recording, roll_out
from oat_gym.generation._layers import one_thread
from oat_gym.ope.gaussian import GaussianPolicy
from oat_gym.spaces import Batch

FloatArray = npt.NDArray[np.float64]
Layers = list[tuple[torch.Tensor, torch.Tensor]]

SNAPSHOTS = (0, 34, 46, 58, 74, 98, 250, 700, 1000, 1250, 3000)
HIDDEN = 64
LEARNING_RATE = 1e-4
BATCH = 256
PLANNER = Planner()
WALK_NOISES = (0.3, 1.0)
WALKS = 200  # episodes for each noise
RANDOM_STATES = 20_000
FIRST_SEED = 1_000_000  # far from the seeds of the true values


def walked_states(*, seed: int) -> FloatArray:
    """Return states and goals (n, 6) of walks of the memoryless planner with little and with much noise."""

    def act(observations: Batch) -> FloatArray:
        rows = features(observations)
        return memoryless_actions(rows[:, :4], rows[:, 4:], planner=PLANNER)

    found: list[FloatArray] = []
    with open_mazes(25) as envs:
        for noise in WALK_NOISES:
            walker = GaussianPolicy(act, noise, ACTION_SPACE)
            seeds = range(FIRST_SEED, FIRST_SEED + WALKS)
            walks = roll_out(envs, walker, seeds=seeds, horizon=HORIZON, policy_seed=seed, record=Recording())
            found += [features(walk.observations)[:-1] for walk in walks.episodes]
    return np.concatenate(found)


def random_states(count: int, *, rng: np.random.Generator) -> FloatArray:
    """Return states and goals (n, 6) anywhere in the free cells, with standard normal velocities."""
    centers = np.array([UMAZE.center(cell) for cell in UMAZE.free])
    positions = centers[rng.integers(len(centers), size=count)] + rng.uniform(-0.5, 0.5, (count, 2))
    goals = centers[rng.integers(len(centers), size=count)] + rng.uniform(-0.25, 0.25, (count, 2))
    return np.concatenate([positions, rng.standard_normal((count, 2)), goals], axis=1)


def initial_layers(inputs: int, outputs: int, generator: torch.Generator) -> Layers:
    """Return weights and biases, uniform within 1/sqrt(inputs) of each layer."""
    sizes = (inputs, HIDDEN, HIDDEN, outputs)
    layers: Layers = []
    for wide, out in pairwise(sizes):
        drawn = [(2 * torch.rand(shape, generator=generator) - 1) / wide**0.5 for shape in ((out, wide), (out,))]
        layers.append((drawn[0].requires_grad_(), drawn[1].requires_grad_()))
    return layers


def forward(layers: Layers, x: torch.Tensor) -> torch.Tensor:
    """Return the network's outputs (n, outputs)."""
    for weight, bias in layers[:-1]:
        x = torch.tanh(torch.nn.functional.linear(x, weight, bias))
    return torch.nn.functional.linear(x, *layers[-1])


def in_raw_units(layers: Layers, mean: FloatArray, scale: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return the layers as arrays, with the standardisation of the inputs folded into the first."""
    arrays = [(weight.detach().double().numpy(), bias.detach().double().numpy()) for weight, bias in layers]
    weight, bias = arrays[0]
    return [(weight / scale, bias - weight @ (mean / scale)), *((w.copy(), b.copy()) for w, b in arrays[1:])]


def train(
    states: FloatArray, snapshots: tuple[int, ...], *, rng: np.random.Generator
) -> list[list[tuple[FloatArray, FloatArray]]]:
    """Return the layers after each number of updates in `snapshots` (ascending)."""
    actions = memoryless_actions(states[:, :4], states[:, 4:], planner=PLANNER)
    mean, scale = states.mean(axis=0), states.std(axis=0)
    x, y = torch.tensor((states - mean) / scale).float(), torch.tensor(actions).float()
    generator = torch_generator(rng)
    layers = initial_layers(x.shape[1], y.shape[1], generator)
    optimiser = torch.optim.Adam([part for layer in layers for part in layer], lr=LEARNING_RATE)
    kept: list[list[tuple[FloatArray, FloatArray]]] = []
    for update in range(snapshots[-1] + 1):
        if update in snapshots:
            kept.append(in_raw_units(layers, mean, scale))
        rows = torch.randint(len(x), (BATCH,), generator=generator)
        optimiser.zero_grad()
        torch.nn.functional.mse_loss(forward(layers, x[rows]), y[rows]).backward()
        optimiser.step()
    return kept


def main() -> None:
    """Read the command line, train and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "maze2d-umaze" / "policies")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rng = derive(options.seed, "maze2d-umaze policies")
    states = np.concatenate([walked_states(seed=options.seed), random_states(RANDOM_STATES, rng=rng)])
    with one_thread():
        snapshots = train(states, SNAPSHOTS, rng=rng)
    for name, layers in zip(NAMES, snapshots, strict=True):
        save_layers(options.out / f"{name}.safetensors", layers)
    print(f"wrote {len(NAMES)} policies to {options.out}")


if __name__ == "__main__":
    main()
