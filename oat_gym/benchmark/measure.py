"""What a cell cost and where it was computed: clocks, peak memory, versions."""

from __future__ import annotations

import platform
import resource
import subprocess
import sys
import time
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import oat_gym

_LIBRARIES = ("numpy", "scipy", "scikit-learn", "torch", "gymnasium", "minari")
_CPUINFO = Path("/proc/cpuinfo")


@dataclass
class Clock:
    """CPU (of this process, all threads) and wall seconds since it was made, and the greatest memory since then."""

    cpu: float = field(default_factory=time.process_time)
    wall: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        _reset_peak()

    def cost(self) -> dict[str, float]:
        """Return cpu_seconds, wall_seconds and peak_memory_mb (resident, of the whole process)."""
        return {
            "cpu_seconds": round(time.process_time() - self.cpu, 3),
            "wall_seconds": round(time.perf_counter() - self.wall, 3),
            "peak_memory_mb": round(_peak() / 2**20, 1),
        }


def _reset_peak() -> None:
    """Start the kernel's record of the peak anew; other systems than Linux keep that of the process's whole life."""
    place = Path("/proc/self/clear_refs")
    if place.exists():
        try:
            place.write_text("5")
        except OSError:
            return


def _peak() -> float:
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024
    peak = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak if sys.platform == "darwin" else peak * 1024


def environment(device: str) -> dict[str, Any]:
    """Return versions, commit (where known), processor and device, for a cell's record."""
    versions = {name: metadata.version(name) for name in _LIBRARIES}
    return {
        "oat_gym": oat_gym.__version__,
        "commit": commit(),
        "python": platform.python_version(),
        **versions,
        "machine": f"{platform.system()} {platform.machine()} {processor()} {torch.backends.cpu.get_cpu_capability()}",
        "device": device_name(device),
    }


def processor(cpuinfo: Path = _CPUINFO) -> str:
    """Return what is known of the processor's maker, by which torch's MKL chooses its kernels."""
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    makers = (line.partition(":")[2].strip() for line in lines if line.startswith("vendor_id"))
    return next(makers, platform.processor())


def device_name(device: str) -> str:
    """Return "cpu", or the name of a CUDA device."""
    return torch.cuda.get_device_name(device) if device.startswith("cuda") and torch.cuda.is_available() else device


@cache
def commit() -> str:
    """Return the commit of the checkout that the package is in ("+" behind it: with changes), "" where unknown."""
    root = Path(oat_gym.__file__).parents[1]
    if not (root / ".git").exists():
        return ""
    try:
        found = [_git(root, "rev-parse", "--short=12", "HEAD"), _git(root, "status", "--porcelain", "--", "oat_gym")]
    except (OSError, subprocess.SubprocessError):
        return ""
    return found[0] + ("+" if found[1] else "")


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(  # noqa: S603  (fixed arguments)
        ["git", "-C", str(root), *arguments],  # noqa: S607
        capture_output=True,
        text=True,
        check=True,
        timeout=10,
    )
    return done.stdout.strip()
