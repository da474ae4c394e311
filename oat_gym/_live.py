"""The plans of augmented datasets that live in this process, by the directory that Minari knows them by."""

from __future__ import annotations

import os
import shutil
import weakref
from pathlib import Path

from oat_gym.synthesis import Synthesis

LIVE: weakref.WeakValueDictionary[str, Synthesis] = weakref.WeakValueDictionary()
"""Minari re-opens a dataset by its path (`split_dataset`, `spec.data_path`): within a process the same plan answers."""


def attach(path: Path, synthesis: Synthesis, *, owned: bool) -> None:
    """Let a plan answer for a directory; one that it owns is removed when the plan is no longer used."""
    LIVE[str(path)] = synthesis
    if owned:
        weakref.finalize(synthesis, _remove, str(path), os.getpid())


def _remove(path: str, pid: int) -> None:
    if os.getpid() == pid:  # a forked worker must not take its parent's directory away
        shutil.rmtree(path, ignore_errors=True)
