"""Early stopping for K networks trained side by side."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


class BestTracker:
    """Keeps each member's best weights by its held-out score, and stops it when the score no longer rises.

    A stopped member's weights and history do not change any more, whatever the others do. With `patience=None`
    nobody stops, and the last weights are kept. A member whose score is not finite has diverged and stops for good.
    Patience runs from update `start` on.

    Attributes:
        score: (K,) score of the kept weights.
        weights: (K, P) the kept weights.
        finite: (K,) whether the last score looked at was finite.
    """

    def __init__(self, members: int, *, patience: int | None, start: int = 0) -> None:
        self._patience, self._start = patience, start
        self.score = torch.full((members,), -torch.inf)
        self.finite = torch.ones(members, dtype=torch.bool)
        self.weights = torch.empty(0)
        self._best_update = torch.zeros(members, dtype=torch.int64)
        self._active = torch.ones(members, dtype=torch.bool)
        self._looks: list[tuple[int, Tensor, Tensor, Tensor]] = []

    @property
    def all_stopped(self) -> bool:
        """Whether every member has stopped."""
        return not bool(self._active.any())

    def look(self, update: int, train: Tensor, score: Tensor, flat: Tensor) -> None:
        """Take in training and held-out scores (K,) after `update` updates, with weights (K, P)."""
        train, score = train.detach().cpu(), score.detach().cpu()
        self._looks.append((update, train, score, self._active.clone()))
        finite = torch.isfinite(score) & torch.isfinite(train)
        self.finite = torch.where(self._active, finite, self.finite)
        better = self._active & finite & ((score > self.score) | torch.tensor(self._patience is None))
        self.weights = flat.detach().clone() if not len(self.weights) else self.weights
        self.weights[better.to(flat.device)] = flat.detach()[better.to(flat.device)]
        lost = self._active & ~finite  # diverged: even its earlier weights are not trusted
        self.score = torch.where(better, score, torch.where(lost, -torch.inf, self.score))
        self._best_update = torch.where(better, update, self._best_update)
        self._active &= finite
        if self._patience is not None:
            self._active &= update - self._best_update.clamp(min=self._start) < self._patience

    def history(
        self, member: int, *, held_out: bool
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the updates looked at, training scores and held-out scores (NaN without a held-out part)."""
        looks = [look for look in self._looks if look[3][member]]
        held = [float(score[member]) if held_out else np.nan for _, _, score, _ in looks]
        return (
            np.array([look[0] for look in looks]),
            np.array([float(look[1][member]) for look in looks]),
            np.array(held),
        )
