"""Where a command writes (`--out`): made, and seen to take files, before any work is done."""

from __future__ import annotations

import tempfile
from pathlib import Path

from oat_gym.errors import ConfigurationError, SaveError


def prepare_folder(folder: Path, *, option: str = "--out") -> None:
    """Make the folder that an option names, and see that it takes files.

    Raises:
        ConfigurationError: if it is a file.
        SaveError: if it cannot be made, or nothing can be written there.
    """
    if folder.exists() and not folder.is_dir():
        raise ConfigurationError(f"{option} must be a folder, and {str(folder)!r} is a file: give another name.")
    _check_writable(folder, f"{option} {str(folder)!r}")


def prepare_file(file: Path, *, option: str = "--out") -> None:
    """Make the folder of the file that an option names, and see that it takes files.

    Raises:
        ConfigurationError: if the file's name is that of a folder.
        SaveError: if its folder cannot be made, or nothing can be written there.
    """
    if file.is_dir():
        raise ConfigurationError(f"{option} must be a file, and {str(file)!r} is a folder: name a file in it.")
    _check_writable(file.parent, f"{option} {str(file)!r}")


def _check_writable(folder: Path, given: str) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        # Its own text names a temporary file; and what is in the way "exists", where a folder may as well.
        reason = "it is a file" if folder.is_file() else error.strerror or type(error).__name__
        raise SaveError(
            f"{given} cannot be written: the folder {str(folder.absolute())!r} takes no files ({reason}). Give a place "
            "where you may write."
        ) from error
