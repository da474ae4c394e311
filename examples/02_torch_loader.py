"""Feed torch from an augmented dataset: transitions, windows, episodes, resumption, and a plain DataLoader.

    python examples/02_torch_loader.py [fork|spawn]

`oat_gym.to_torch` keeps the data in memory (or memory-mapped) and takes each batch by one index, so it needs no worker
processes. A plain `torch.utils.data.DataLoader` works too: its batches do not depend on the number of workers.
"""

import sys

import minari
import numpy as np
import torch
from torch.utils.data import DataLoader

import oat_gym


def noisy_actions(episode: minari.EpisodeData, rng: np.random.Generator) -> minari.EpisodeData:
    """Return the episode with a little noise on its actions: a stand-in for a real augmenter such as OAT()."""
    episode.actions[:] = np.clip(episode.actions + 0.05 * rng.normal(size=episode.actions.shape), -1, 1)
    return episode


def pad(episodes: list[minari.EpisodeData]) -> list[torch.Tensor]:
    """Pad the actions and rewards of the episodes of a batch: the collate function of a plain DataLoader."""
    parts = [[torch.as_tensor(getattr(episode, name)) for episode in episodes] for name in ("actions", "rewards")]
    return [torch.nn.utils.rnn.pad_sequence(part, batch_first=True) for part in parts]


def main(start_method: str) -> None:
    data = oat_gym.AugmentedDataset("oat_gym/maze2d-umaze-v0", oat_gym.Function(noisy_actions), count=50, seed=0)
    print(f"{len(data)} episodes, {data.total_steps} steps")

    # Transitions, a new order each epoch. Observations come as the space is nested; flat=True gives one matrix.
    loader = oat_gym.to_torch(data, batch_size=512, seed=0)
    batch = next(iter(loader))
    print(
        "transitions:", {key: tuple(part.shape) for key, part in batch.observations.items()}, tuple(batch.actions.shape)
    )

    # Half of each batch from generated steps, whatever their share of the data.
    mixed = oat_gym.to_torch(data, batch_size=512, sampling="replacement", real_fraction=0.5, flat=True, seed=0)
    share = torch.cat([batch.synthetic for batch in mixed.batches(20)]).double().mean()
    print(f"weighted: {share:.2f} of the sampled steps are synthetic, {data.transitions().synthetic.mean():.2f} of all")

    # Windows of 10 steps (11 observations) of one episode, and whole episodes padded to the longest of their batch.
    windows = oat_gym.to_torch(data, kind="windows", length=10, stride=5, batch_size=64, flat=True)
    print("windows:", tuple(next(iter(windows)).observations.shape), "in", len(windows), "batches an epoch")
    episodes = next(iter(oat_gym.to_torch(data, kind="episodes", batch_size=8, flat=True)))
    print("episodes:", tuple(episodes.rewards.shape), "of which recorded steps:", int(episodes.mask.sum()))

    # Stop in mid-epoch and go on, in this process or in another one: the same remaining batches.
    rest = iter(loader)
    next(rest)
    again = oat_gym.to_torch(data, batch_size=512, seed=0)
    again.load_state_dict(loader.state_dict())
    print("resumed:", all(torch.equal(a.rewards, b.rewards) for a, b in zip(rest, again, strict=True)))

    # A plain DataLoader, with and without workers.
    for workers in (0, 2):
        plain = DataLoader(
            data,
            batch_size=50,
            shuffle=True,
            generator=torch.Generator().manual_seed(0),
            collate_fn=pad,
            num_workers=workers,
            multiprocessing_context=start_method if workers else None,
        )
        print(f"DataLoader, {workers} workers: {sum(float(actions.sum()) for actions, _ in plain):.6f}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "fork")
