"""What the benchmark asks: suites of datasets, the question put to estimators, and cells with their fingerprints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt
from minari import MinariDataset

from oat_gym import domains
from oat_gym._rng import check_seed
from oat_gym.benchmark.budget import BUDGETS, Budget
from oat_gym.benchmark.ground import Ground
from oat_gym.benchmark.variants import ALL, VARIANTS, Variant, fit_length
from oat_gym.cache import canonical, fingerprint
from oat_gym.domains import sepsis
from oat_gym.errors import ConfigurationError
from oat_gym.ope import AgreementCurve, Estimator, Policy
from oat_gym.spaces import Batch

FORMAT = 2
"""Part of every fingerprint: raise it when a change of the benchmark makes older cells incomparable."""
Initial = Literal["reset", "data"]
Curves = Callable[[MinariDataset, Mapping[str, Policy]], dict[str, AgreementCurve]]


@dataclass(frozen=True)
class Question:
    """What is asked about every dataset.

    Args:
        initial: where values count from: "reset", states in which the task's environment starts episodes (where the
            true values count from; the data's for tasks without an environment), or "data", the logged first states.
        resets: number of reset states.
        resamples: bootstrap resamples of the source episodes.
        behavior: "clone" or "logged" (`ope.evaluate`).
        gamma: discount; None: the task's.
    """

    initial: Initial = "reset"
    resets: int = 200
    resamples: int = 400
    behavior: Literal["clone", "logged"] = "clone"
    gamma: float | None = None

    def __post_init__(self) -> None:
        if self.initial not in get_args(Initial) or self.behavior not in ("clone", "logged"):
            raise ConfigurationError(
                f"initial must be reset or data and behavior clone or logged, got {self.initial!r}, {self.behavior!r}."
            )
        if self.resets < 1 or self.resamples < 2:
            raise ConfigurationError(f"resets must be at least 1 and resamples 2, got {self.resets}, {self.resamples}.")

    def starts(self, task: domains.Task) -> Batch | None:
        """Return the states that a task's values count from; None for the data's own."""
        if self.initial == "data" or task.initial_states is None:
            return None
        return task.initial_states(self.resets, 0)


@dataclass(frozen=True)
class Cell:
    """One estimator on one dataset, augmented in one way, with one seed; all policies of the task at once.

    Attributes:
        dataset: its name in `domains.DATASETS`.
        ground: what all cells of the dataset share.
        variant: the way of augmenting.
        estimator: (key of the family, estimator).
        seed: of the augmentation and of the estimator.
        question: what is asked.
        budget: settings that all cells share.
    """

    dataset: str
    ground: Ground
    variant: Variant
    estimator: tuple[str, Estimator]
    seed: int
    question: Question
    budget: Budget

    @property
    def config(self) -> dict[str, Any]:
        """All that the result depends on, as plain JSON data."""
        budget = self.budget
        return canonical(
            {
                "format": FORMAT,
                "dataset": self.dataset,
                "ground": self.ground,
                "episodes": budget.episodes,
                "variant": self.variant.description(),
                "estimator": self.estimator[1],
                "cloning": budget.cloning,
                "seed": self.seed,
                "question": self.question,
            }
        )

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the configuration."""
        return fingerprint(cell=self.config)

    @property
    def name(self) -> str:
        """The cell's file, relative to the folder of results and without an ending."""
        return f"{self.place}-{self.fingerprint[:16]}"

    @property
    def place(self) -> str:
        """The cell's place in the tables: cells of changed settings have the same one."""
        return f"cells/{self.dataset}/{self.variant.name}/{self.estimator[0]}-{self.seed}"


@dataclass(frozen=True)
class Job:
    """The cells of one dataset, variant and seed: they share one augmented dataset and all that is fitted to it."""

    dataset: str
    ground: Ground
    variant: Variant
    seed: int
    question: Question
    budget: Budget
    device: str = "cpu"

    def cells(self) -> tuple[Cell, ...]:
        """Return a cell for each estimator of the budget."""
        return tuple(
            Cell(self.dataset, self.ground, self.variant, estimator, self.seed, self.question, self.budget)
            for estimator in self.budget.estimators
        )

    @property
    def name(self) -> str:
        """The file that says what was mined and generated, without an ending."""
        parts = {"dataset": self.dataset, "data": self.ground.data, "episodes": self.budget.episodes, "seed": self.seed}
        key = fingerprint(format=FORMAT, variant=self.variant.description(), **parts)
        return f"augmented/{self.dataset}/{self.variant.name}-{self.seed}-{key[:16]}"


@dataclass(frozen=True)
class Suite:
    """Datasets that are evaluated together.

    `budget` is the name of the budget where `--budget` does not say otherwise, `variants` what `--augmenters all`
    means, `seeds` the default number of seeds.
    """

    name: str
    datasets: tuple[str, ...]
    about: str
    budget: str = "standard"
    variants: tuple[str, ...] = ALL
    seeds: int = 3

    def __post_init__(self) -> None:
        if not self.datasets or self.budget not in BUDGETS or not set(self.variants) <= set(VARIANTS):
            raise ConfigurationError(f"A suite needs datasets, a known budget and known variants, got {self!r}.")


_ADROIT = ("pen", "door", "relocate", "hammer")

SUITES: dict[str, Suite] = {
    suite.name: suite
    for suite in (
        Suite(
            "adroit-human",
            tuple(f"adroit-{task}-human" for task in _ADROIT),
            "four tasks of a robot hand, demonstrations by people (tables 2 to 6)",
        ),
        Suite(
            "adroit-cloned",
            tuple(f"adroit-{task}-{kind}" for kind in ("cloned", "cloned-from-expert") for task in _ADROIT),
            "the same tasks, half demonstrations and half roll-outs of their clone (tables 7 to 10)",
        ),
        Suite(
            "adroit-expert",
            tuple(f"adroit-{task}-expert" for task in _ADROIT),
            "the same tasks, roll-outs of an expert policy (tables 11 to 14)",
        ),
        Suite("adroit-door-human", ("adroit-door-human",), "the real door demonstrations alone"),
        Suite(
            "sepsis",
            ("sepsis-sim", "icu-sepsis-features", "sepsis-mdp-features", "sepsis-clif"),
            "sepsis treatment (figure 7, right)",
        ),
        Suite("tutoring", ("tutor-sim", "tutoring-smartprimer"), "intelligent tutoring (figures 6, 7 and 9, table 1)"),
        Suite("maze2d", ("maze2d-umaze", "maze2d-umaze-d4rl"), "a point mass in a U-shaped maze (figure 4)"),
        Suite("quick", ("maze2d-umaze",), "every part of the benchmark, in minutes", budget="quick", seeds=2),
    )
}
"""The suites by name."""


def find_suite(name: str) -> Suite:
    """Return the suite of a name.

    Raises:
        ConfigurationError: for an unknown name.
    """
    if name not in SUITES:
        raise ConfigurationError(f"There is no suite {name!r}; choose of {', '.join(SUITES)}.")
    return SUITES[name]


@dataclass(frozen=True)
class Catalog:
    """Where names of datasets lead: by default the installed domains; tests and users may give their own.

    Attributes:
        datasets: name -> function that opens it.
        tasks: name -> task.
        curves: dataset -> (event, function of dataset and policies that returns how often the event happened by
            agreement with each policy): what can be said where nobody knows the true values.
    """

    datasets: Mapping[str, Callable[[], MinariDataset]]
    tasks: Mapping[str, domains.Task]
    curves: Mapping[str, tuple[str, Curves]] = field(default_factory=dict[str, tuple[str, "Curves"]])

    @classmethod
    def installed(cls) -> Catalog:
        """Return `domains.DATASETS`, `domains.TASKS` and the septic-shock curves of the real visits."""
        return cls(domains.DATASETS, domains.TASKS, {"sepsis-clif": ("septic shock", sepsis.shock_curves)})

    def load(self, name: str, *, episodes: int | None = None) -> MinariDataset:
        """Return a dataset, or a view of its first `episodes`.

        Raises:
            ConfigurationError: for an unknown name.
            DatasetNotFoundError: if the data is not on this machine.
        """
        if name not in self.datasets:
            raise ConfigurationError(f"There is no dataset named {name!r} in this version.")
        dataset = self.datasets[name]()
        if episodes is None or len(dataset) <= episodes:
            return dataset
        return MinariDataset(dataset.storage, episode_indices=dataset.episode_indices[:episodes])

    def task_of(self, dataset: str) -> tuple[str, domains.Task]:
        """Return the name and the task of a dataset.

        Raises:
            ConfigurationError: where no task has it.
        """
        for name, task in self.tasks.items():
            if dataset in task.datasets:
                return name, task
        raise ConfigurationError(f"No task of this version evaluates policies on the dataset {dataset!r}.")


def make_jobs(
    data: Mapping[str, tuple[Ground, npt.NDArray[np.int64]]],
    variants: Sequence[Variant],
    *,
    seeds: Sequence[int],
    question: Question,
    budget: Budget,
    device: str,
) -> tuple[Job, ...]:
    """Return the jobs of some datasets, those of one dataset and seed beside each other.

    `data` gives the ground of each dataset and the lengths of its episodes (for `fit_length`).
    """
    jobs: list[Job] = []
    for name, (ground, lengths) in data.items():
        fitted = [_fitted(variant, lengths, budget) for variant in variants]
        jobs += [
            Job(name, ground, variant, check_seed(seed), question, budget, device)
            for seed in seeds
            for variant in fitted
        ]
    return tuple(jobs)


def _fitted(variant: Variant, lengths: npt.NDArray[np.int64], budget: Budget) -> Variant:
    if variant.augmenter is None:
        return variant
    return replace(variant, augmenter=fit_length(budget.augmenter(variant.augmenter), lengths))
