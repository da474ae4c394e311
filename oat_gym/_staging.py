"""Temporary folders that tell who made them, so that those of killed processes can be removed."""

from __future__ import annotations

import glob
import os
import platform
import shutil
import tempfile
from pathlib import Path


def owned_folder(prefix: str, parent: Path) -> Path:
    """Make and return a temporary folder in `parent`, first removing those of ended processes of this machine.

    The name is `prefix`, the place (`_place`), the process id and a random part. Raises OSError where the disk refuses.
    """
    remove_abandoned(prefix, parent)
    return Path(tempfile.mkdtemp(prefix=f"{prefix}{_place()}-{os.getpid()}-", dir=parent))


def remove_abandoned(prefix: str, parent: Path) -> None:
    """Remove the folders that `owned_folder` made in processes of this machine that no longer run."""
    for folder in parent.glob(f"{glob.escape(prefix)}*-*-*"):
        place, owner, _ = folder.name.removeprefix(prefix).rsplit("-", 2)
        if place == _place() and owner.isdecimal() and not is_running(int(owner)):
            shutil.rmtree(folder, ignore_errors=True)


def _place() -> str:
    """Return where process ids mean what they mean here: the host and, on Linux, the namespace of process ids.

    Containers that share a folder may share the host's name too, and see different processes.
    """
    try:
        return f"{platform.node()}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:
        return platform.node()


def is_running(pid: int) -> bool:
    """Return whether a process of this machine has the id `pid`."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
