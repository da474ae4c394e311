"""A training loop in one file, CleanRL-style: the value of the behaviour policy by TD learning, and a cloned policy.

    python examples/04_training_loop.py

Everything is in sight: settings, networks, one loop. The data may be any Minari dataset or an augmented one; here it is
the embedded Maze2D dataset with an augmenter that needs no training.
"""

import copy
import time

import minari
import numpy as np
import torch
from torch import nn

import oat_gym

SEED = 0
UPDATES = 200
BATCH_SIZE = 512
LEARNING_RATE = 1e-3
GAMMA = 0.99
TAU = 0.05  # step of the target network


def jitter(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    """Return the episode with noise on its observed positions: a stand-in for a real augmenter such as OAT()."""
    states = episode.observations["observation"]
    states += 0.01 * rng.normal(size=states.shape).astype(states.dtype)
    return episode


def network(inputs: int, outputs: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, outputs))


if __name__ == "__main__":
    torch.manual_seed(SEED)
    torch.set_num_threads(1)  # networks this small run faster so
    data = oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", oat_gym.Function(jitter), factor=2, seed=SEED)
    loader = oat_gym.to_torch(
        data, batch_size=BATCH_SIZE, sampling="replacement", real_fraction=0.5, flat=True, seed=SEED
    )
    first = next(iter(loader))
    width, action_width = first.observations.shape[1], first.actions.shape[1]

    critic, actor = network(width, 1), network(width, action_width)
    target = copy.deepcopy(critic)
    optimizer = torch.optim.Adam([*critic.parameters(), *actor.parameters()], lr=LEARNING_RATE)

    start = time.time()
    for update, batch in enumerate(loader.batches(UPDATES), start=1):
        # A terminated step has no future; a truncated one does: it bootstraps.
        with torch.no_grad():
            alive = (~batch.terminated).float()
            returns = batch.rewards + GAMMA * alive * target(batch.next_observations).squeeze(1)
        value_loss = nn.functional.mse_loss(critic(batch.observations).squeeze(1), returns)
        policy_loss = nn.functional.mse_loss(actor(batch.observations), batch.actions)

        optimizer.zero_grad()
        (value_loss + policy_loss).backward()
        optimizer.step()
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), critic.parameters(), strict=True):
                slow.lerp_(fast, TAU)

        if update % 50 == 0:
            rate = int(update / (time.time() - start))
            print(f"update {update}: value loss {value_loss:.4f}, policy loss {policy_loss:.4f}, {rate} updates/s")

    # The value of the behaviour policy where the real episodes start.
    real = oat_gym.to_torch(data.source, kind="episodes", sampling="sequential", batch_size=len(data), flat=True)
    starts = next(iter(real)).observations[:, 0]
    print(f"mean value of the real initial states: {critic(starts).mean().item():.3f}")
