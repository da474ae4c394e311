"""The exceptions that the package raises. Each is also the built-in error a caller would expect."""


class OatGymError(Exception):
    """Base of every error that oat_gym raises on purpose."""


class ConfigurationError(OatGymError, ValueError):
    """A setting has a value that cannot work; the message says what was got and what is expected."""


class InvalidDataError(OatGymError, ValueError):
    """The data breaks a rule of the method: NaN, an empty dataset, lengths that do not agree."""


class ShortEpisodesError(InvalidDataError):
    """No episode has room for a sub-trajectory: `finding` says so, and `length` would leave room (0: none would)."""

    def __init__(self, finding: str, length: int, advice: str) -> None:
        super().__init__(finding, length, advice)  # all of them, so that it can be pickled
        self.finding = finding
        self.length = length
        self.advice = advice

    def __str__(self) -> str:
        """Return the finding with the advice that fits a call from Python."""
        return f"{self.finding} {self.advice}"


class UnsupportedSpaceError(OatGymError, TypeError):
    """A Gymnasium space that the chosen method cannot model; the message names the space."""


class TrainingError(OatGymError, RuntimeError):
    """Training diverged; the message names the PST set. No data is produced."""


class CacheError(OatGymError, RuntimeError):
    """The cache on disk cannot be used and could not be rebuilt."""


class NewerFormatError(CacheError):
    """A file was written by a newer version of the library: not damaged, not readable here, and to be left alone."""


class DatasetExistsError(OatGymError, FileExistsError):
    """A dataset of this id is already there; nothing was written."""


class SaveError(OatGymError, OSError):
    """A dataset could not be saved because the disk refused; nothing was left half-written."""


class DatasetNotFoundError(OatGymError, FileNotFoundError):
    """Data is not on this machine; the message says how to get it."""


class SourceChangedError(OatGymError, RuntimeError):
    """A recipe's source no longer has the content that it was made from."""


class AugmentationWarning(UserWarning):
    """The augmented dataset is sound, but holds less than expected: fewer generated steps, or seams that were lost."""


class EstimationWarning(UserWarning):
    """An estimate was made, and there is a reason not to trust it."""


class ConformanceError(OatGymError, AssertionError):
    """A dataset, augmenter or estimator broke its contract (see `oat_gym.checks`)."""
