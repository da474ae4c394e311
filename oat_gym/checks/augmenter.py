"""The contract of an augmenter, as checks that anyone can run on a method of their own."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

from minari import MinariDataset

from oat_gym._rng import check_seed
from oat_gym.augmenters._parts import methods_in
from oat_gym.augmenters.base import Augmenter
from oat_gym.checks._augmenter_output import OUTPUT_CHECKS, each
from oat_gym.checks._augmenter_settings import SETTINGS_CHECKS
from oat_gym.checks._compare import difference
from oat_gym.checks._probe import Probe, continuous_probe, discrete_probe, one_step_probe
from oat_gym.checks._trial import VARIATIONS, FittedOnce, Trial, Trials, run_trial
from oat_gym.checks.dataset import check_dataset
from oat_gym.checks.report import Broken, Check, ChecksFailed, NotApplicable, Report, run_checks
from oat_gym.dataset import AugmentedDataset
from oat_gym.errors import AugmentationWarning, ConfigurationError


def zero_strength(trials: Trials) -> int:
    """At zero strength a variation is its source."""
    zero = trials.augmenter.at_zero_strength
    if zero is None:
        raise Broken("at_zero_strength is None: give it, or say in expected_failures why the method has no such")
    count = 0
    for name, trial in trials.done.items():
        made = run_trial(zero, trial.source.dataset, seed=trials.seed)
        for k, i, variation in each(made.variations):
            found = difference(variation.episode, made.source.episodes[i])
            if found:
                raise Broken(f"{name}: at zero strength, variation {k} of episode {i} is not its source: {found}")
            count += 1
    return count


def conformance(trials: Trials) -> int:
    """An augmented dataset of it passes `check_dataset`."""
    return sum(_conforms(_augmented(trials, trial), name, trials) for name, trial in trials.done.items())


def augmented_twice(trials: Trials) -> int:
    """It augments what it has augmented, and the result passes `check_dataset`."""
    for name, trial in trials.done.items():
        once = _augmented(trials, trial)
        try:
            twice = AugmentedDataset(once, once.augmenter, count=VARIATIONS * len(once), seed=trials.seed)
        except ConfigurationError as error:
            if name == "own":  # what refused the small datasets, such as one label for each episode
                raise NotApplicable(f"its settings are for the dataset given alone: {error}") from error
            raise
        return _conforms(twice, f"{name}, augmented twice", trials)
    raise NotApplicable("the augmenter ran on no dataset")


def _augmented(trials: Trials, trial: Trial) -> AugmentedDataset:
    fitted = FittedOnce((trials.augmenter,), {(trial.source.fingerprint, trials.seed): trial.sampler})
    return AugmentedDataset(trial.source.dataset, fitted, count=VARIATIONS * len(trial.source), seed=trials.seed)


def _conforms(dataset: AugmentedDataset, name: str, trials: Trials) -> int:
    try:
        report = check_dataset(dataset, limit=trials.limit)
    except ChecksFailed as error:
        findings = "; ".join(f"{check}: {message}" for check, message in error.report.failed)
        raise Broken(f"{name}: check_dataset finds {findings}") from error
    return len(report.passed)


_RUNS = ("continuous", "discrete", "own-dataset")
_PROMISES = ("determinism", "memory", "lengths", "spaces", "flags")
AUGMENTER_CHECKS: tuple[Check[Trials], ...] = (
    *SETTINGS_CHECKS,
    *OUTPUT_CHECKS,
    Check("zero-strength", "zero strength is the identity", zero_strength, ("source-unchanged",), _RUNS),
    Check(
        "conformance",
        "the augmented dataset passes check_dataset",
        conformance,
        _PROMISES,
        ("picklable", "alignment", *_RUNS),
    ),
    Check("augmented-twice", "an augmented dataset can be augmented", augmented_twice, ("conformance",)),
)
"""Every check of `check_augmenter`, in the order in which they are run."""


def check_augmenter(
    augmenter: Augmenter, dataset: MinariDataset | None = None, *, seed: int = 0, limit: int | None = 12
) -> Report:
    """Hold the contract of an augmenter against one, configured as it is: a user's own or one of `AUGMENTERS`.

    The rules are in `AUGMENTER_CHECKS`. It is run on small datasets made for it, whose values tell the episode and
    step that they belong to: eight episodes of 1 to 35 steps, once in Box spaces (every second one terminates), once in
    Discrete and Dict ones (none does), and once of a single step each. It is fitted seven times to these, and twice
    more to `dataset`, so a method that trains is to be given settings for quick training. Nothing is kept on disk.

    What a method cannot do, it declares: `expected_failures` maps the name of a check to the reason. The check must
    then fail. A method without a setting that is a strength declares "zero-strength", for example. One that is made of
    others (`Compose`, `Mixture`) may fail what its parts declare, and may pass it: a part can make up for another.

    Args:
        augmenter: the configuration to check.
        dataset: a Minari dataset to run it on as well. Settings that are for this data, and refuse the small
            datasets by a `ConfigurationError`, are then checked on it alone.
        seed: the seed of everything random in it.
        limit: how many episodes of each augmented dataset `check_dataset` looks at; None: all.

    Returns:
        The report of the checks that passed, of those that failed as expected, and of those that had nothing to look
        at, each with its reason.

    Raises:
        ChecksFailed: (a `ConformanceError`) listing every check that failed, with the first thing that broke it.
        ConfigurationError: for something that is no augmenter, no Minari dataset, or a seed or limit that is none.

    >>> from oat_gym import AUGMENTERS
    >>> report = check_augmenter(AUGMENTERS["jittering"]())
    >>> report.counts["zero-strength"], report.expected_failed
    (32, ())
    """
    if not isinstance(augmenter, Augmenter):
        raise ConfigurationError(f"check_augmenter takes an oat_gym.Augmenter such as OAT(), got {augmenter!r}.")
    if dataset is not None and not isinstance(dataset, MinariDataset):
        raise ConfigurationError(f"dataset must be a minari.MinariDataset or None, got a {type(dataset).__name__}.")
    if limit is not None and limit < 1:
        raise ConfigurationError(f"limit must be at least 1, or None for every episode, got {limit!r}.")
    check_seed(seed)
    with tempfile.TemporaryDirectory(prefix="oat_gym-check-") as name, warnings.catch_warnings():
        warnings.simplefilter("ignore", AugmentationWarning)  # that some episodes are too short for the method
        folder = Path(name)
        probes = [continuous_probe(folder), discrete_probe(folder)]
        probes += [] if dataset is None else [Probe("own", dataset, coded=False)]
        trials = Trials(augmenter, probes, one_step=one_step_probe(folder), seed=seed, limit=limit)
        return run_checks(
            type(augmenter).__name__,
            trials,
            AUGMENTER_CHECKS,
            expected=augmenter.expected_failures,
            may_pass=len(list(methods_in(augmenter))) > 1,
        )
