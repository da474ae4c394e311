"""How long estimators train: named settings, part of every cell's configuration and of every table's caption."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from oat_gym.augmenters import Augmenter
from oat_gym.benchmark.variants import quick_augmenter
from oat_gym.errors import ConfigurationError
from oat_gym.ope import DICE, FQE, BehaviorCloning, DoublyRobust, Estimator, ImportanceSampling, ModelBased

CLIP = (-6.0, 2.0)
"""DOPE's limits of a step's log ratio, which the paper's estimates were made with."""


@dataclass(frozen=True)
class Budget:
    """Settings of the five families, of the cloned behaviour policy, and of how much data and training there is.

    Args:
        name: of the budget.
        estimators: (key, estimator) of each family; the keys are those of `ope.ESTIMATORS`.
        cloning: settings of behaviour cloning.
        quick: train augmenters for a moment only (`quick_augmenter`).
        episodes: use the first so many episodes of a dataset; None: all.

    >>> [key for key, _ in BUDGETS["full"].estimators]
    ['fqe', 'is', 'dice', 'dr', 'mb']
    """

    name: str
    estimators: tuple[tuple[str, Estimator], ...]
    cloning: BehaviorCloning
    quick: bool = False
    episodes: int | None = None

    def __post_init__(self) -> None:
        keys = [key for key, _ in self.estimators]
        if not keys or len(set(keys)) < len(keys):
            raise ConfigurationError(f"estimators needs different keys, at least one, got {keys}.")
        if self.episodes is not None and self.episodes < 2:
            raise ConfigurationError(f"episodes must be at least 2 or None, got {self.episodes!r}.")

    def choose(self, names: str) -> Budget:
        """Return the budget with the estimators of a list like "all" or "fqe,is".

        Raises:
            ConfigurationError: for an unknown name.
        """
        known = dict(self.estimators)
        wanted = list(known) if names.strip() == "all" else [name.strip() for name in names.split(",")]
        unknown = [name for name in wanted if name not in known]
        if unknown:
            raise ConfigurationError(f"There is no estimator {', '.join(unknown)}; choose of {', '.join(known)}.")
        return replace(self, estimators=tuple((name, known[name]) for name in dict.fromkeys(wanted)))

    def augmenter(self, augmenter: Augmenter) -> Augmenter:
        """Return an augmenter with this budget's training."""
        return quick_augmenter(augmenter) if self.quick else augmenter

    def describe(self) -> str:
        """Return the budget in a line, for captions."""
        parts = [_updates(key, estimator) for key, estimator in self.estimators]
        text = f"budget {self.name!r}: " + ", ".join(part for part in parts if part)
        text += f"; augmenters trained {'for a moment only' if self.quick else 'in full'}"
        return text + ("" if self.episodes is None else f"; first {self.episodes} episodes of each dataset")


def _updates(key: str, estimator: Any) -> str:
    updates = getattr(getattr(estimator, "q", estimator), "updates", None)
    return "" if updates is None else f"{key} {updates:,} updates"


def _families(
    fqe: FQE, dice: DICE, model: ModelBased, importance: ImportanceSampling
) -> tuple[tuple[str, Estimator], ...]:
    doubly_robust = DoublyRobust(q=fqe, clip=importance.clip)
    return (("fqe", fqe), ("is", importance), ("dice", dice), ("dr", doubly_robust), ("mb", model))


_IS = ImportanceSampling(clip=CLIP)

BUDGETS: dict[str, Budget] = {
    budget.name: budget
    for budget in (
        Budget("full", _families(FQE(), DICE(), ModelBased(), _IS), BehaviorCloning()),
        Budget(
            "standard",
            _families(
                FQE(hidden=(64, 64), updates=6_000, tau=0.02),
                DICE(hidden=(32, 32), updates=3_000, batch_size=128, nu_rate=1e-3),
                ModelBased(hidden=(64, 64), updates=2_000, ensemble=3, max_starts=100),
                _IS,
            ),
            BehaviorCloning(hidden=(128, 128)),
        ),
        Budget(
            "quick",
            _families(
                FQE(hidden=(64, 64), updates=400, batch_size=128),
                DICE(hidden=(32, 32), updates=300, batch_size=128),
                ModelBased(hidden=(64, 64), updates=150, ensemble=2, max_starts=50),
                _IS,
            ),
            BehaviorCloning(hidden=(64, 64), max_updates=200, folds=2),
            quick=True,
            episodes=25,
        ),
    )
}
"""The budgets by name, all with importance ratios clipped as DOPE does.

"full" has the estimators' own defaults. "standard", for the suites, costs a tenth of it: on door-human without
augmentation its FQE and DICE have errors of the same size and its model-based estimates smaller ones; it was chosen by
that, before any augmentation was measured with it.
"quick" is for trying the benchmark out and says nothing about methods."""
