"""What a VAE-MDP is trained on: a set of spans, and the split that holds some of them out."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from oat_gym.errors import InvalidDataError, TrainingError
from oat_gym.generation.config import MIN_GROUPS
from oat_gym.spaces import FloatMatrix, Layout

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sequences:
    """One set of M spans of up to W steps, as flat features (one PST set, or whole trajectories padded to W).

    Attributes:
        states: (M, W+1, state width); row t+1 is the next state of step t.
        actions: (M, W, action width).
        rewards: (M, W).
        groups: (M,) source episode of each span; spans of one episode are never on both sides of the held-out split.
            `None`: each span is its own group.
        mask: (M, W) true for recorded steps, false for padding behind the end of a shorter span; `None`: all recorded.
        terminal: (M, W) true for the step that ended its episode; with it, p(end | z) is learnt. `None`: no end head.
        name: how messages call this set.

    Raises:
        InvalidDataError: if shapes do not agree, or a mask is not a run of true followed by false.
        TrainingError: if a recorded value is NaN or infinite.

    >>> spans = Sequences(np.zeros((4, 3, 2)), np.zeros((4, 2, 1)), np.zeros((4, 2)))
    >>> len(spans), spans.steps
    (4, 2)
    """

    states: npt.NDArray[np.floating[Any]]
    actions: npt.NDArray[np.floating[Any]]
    rewards: npt.NDArray[np.floating[Any]]
    groups: npt.NDArray[np.integer[Any]] | None = None
    mask: npt.NDArray[np.bool_] | None = None
    terminal: npt.NDArray[np.bool_] | None = None
    name: str = "PST set 0"

    def __post_init__(self) -> None:
        if self.actions.ndim != 3 or 0 in self.actions.shape[:2]:
            raise InvalidDataError(
                f"{self.name}: actions must have shape (M, W, action width) with M, W >= 1, got {self.actions.shape}."
            )
        m, steps, _ = self.actions.shape
        state_shape = (m, steps + 1, self.states.shape[-1])
        shapes = {"states": state_shape, "rewards": (m, steps), "groups": (m,), "mask": (m, steps)}
        for field, shape in (shapes | {"terminal": (m, steps)}).items():
            value = getattr(self, field)
            if value is not None and value.shape != shape:
                raise InvalidDataError(
                    f"{self.name}: {field} must have shape {shape} beside actions {self.actions.shape}, "
                    f"got {value.shape}."
                )
        recorded = self.recorded
        if not recorded[:, 0].all() or (recorded[:, 1:] & ~recorded[:, :-1]).any():
            raise InvalidDataError(f"{self.name}: each row of mask must be true for one or more steps, then false.")
        self._check_finite(recorded)

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def steps(self) -> int:
        """W, the number of steps of the longest span."""
        return self.actions.shape[1]

    @property
    def recorded(self) -> npt.NDArray[np.bool_]:
        """(M, W) the mask, all true where none was given."""
        return np.ones(self.actions.shape[:2], dtype=bool) if self.mask is None else self.mask.astype(bool)

    @property
    def recorded_states(self) -> npt.NDArray[np.bool_]:
        """(M, W+1) which states were recorded: the first, and the next state of each recorded step."""
        return np.concatenate((np.ones((len(self), 1), dtype=bool), self.recorded), axis=1)

    @property
    def group_ids(self) -> npt.NDArray[np.integer[Any]]:
        """(M,) the groups, one for each span where none were given."""
        return np.arange(len(self)) if self.groups is None else self.groups

    def check_layouts(self, state_layout: Layout, action_layout: Layout) -> None:
        """Raise `InvalidDataError` unless the widths are those of the layouts."""
        for what, values, layout in (("states", self.states, state_layout), ("actions", self.actions, action_layout)):
            if values.shape[-1] != layout.width:
                raise InvalidDataError(
                    f"{self.name}: {what} have {values.shape[-1]} columns, their layout {layout.width}."
                )

    def rows(self) -> tuple[FloatMatrix, FloatMatrix, FloatMatrix]:
        """Return recorded states (n, width), actions (m, width) and rewards (m, 1), padding left out."""
        recorded = self.recorded
        states, actions = self.states[self.recorded_states], self.actions[recorded]
        rewards = self.rewards[recorded][:, None]
        return states.astype(np.float64), actions.astype(np.float64), rewards.astype(np.float64)

    def _check_finite(self, recorded: npt.NDArray[np.bool_]) -> None:
        for what, values, rows in (
            ("state", self.states, self.recorded_states),
            ("action", self.actions, recorded),
            ("reward", self.rewards, recorded),
        ):
            finite = np.isfinite(values).reshape(*rows.shape, -1).all(-1) | ~rows
            if not finite.all():
                span, step = np.argwhere(~finite)[0]
                raise TrainingError(
                    f"{self.name}: the {what} at step {step} of span {span} is not finite. "
                    "Fill or drop missing values before augmenting."
                )


def hold_out(
    groups: npt.NDArray[np.integer[Any]], *, share: float, rng: np.random.Generator, name: str
) -> npt.NDArray[np.bool_]:
    """Return which rows are held out: all rows of `share` of the groups, at least one group.

    With `share` 0, nothing is. With fewer than `MIN_GROUPS` groups nothing is either, and a warning is logged.
    """
    ids = np.unique(groups)
    if share == 0:
        return np.zeros(len(groups), dtype=bool)
    if len(ids) < MIN_GROUPS:
        _logger.warning(
            "%s comes from %d source episodes; fewer than %d, so none is held out and the training fit decides.",
            name,
            len(ids),
            MIN_GROUPS,
        )
        return np.zeros(len(groups), dtype=bool)
    count = min(max(1, round(share * len(ids))), len(ids) - 1)
    return np.isin(groups, rng.permutation(ids)[:count])
