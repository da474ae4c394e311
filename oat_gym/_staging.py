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

    The name is `prefix`, the host, the process id and a random part. Raises OSError where the disk refuses.
    """
    remove_abandoned(prefix, parent)
    return Path(tempfile.mkdtemp(prefix=f"{prefix}{platform.node()}-{os.getpid()}-", dir=parent))


def remove_abandoned(prefix: str, parent: Path) -> None:
    """Remove the folders that `owned_folder` made in processes of this machine that no longer run."""
    for folder in parent.glob(f"{glob.escape(prefix)}*-*-*"):
        host, owner, _ = folder.name.removeprefix(prefix).rsplit("-", 2)
        if host == platform.node() and owner.isdecimal() and not is_running(int(owner)):
            shutil.rmtree(folder, ignore_errors=True)


def is_running(pid: int) -> bool:
    """Return whether a process of this machine has the id `pid`."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
