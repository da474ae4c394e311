"""Open every dataset that this machine can make, check it, and see that it is made again to the same bytes.

    python datasets/check_datasets.py [--only NAME ...]

Each dataset is made twice, in two empty caches, and must pass `oat_gym.checks.check_dataset`. Those whose source is not
on this machine are named. The exit status is 1 where anything failed. Takes about eight CPU minutes for all.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import tempfile
from pathlib import Path

from oat_gym import domains
from oat_gym.checks import check_dataset
from oat_gym.errors import DatasetNotFoundError, InvalidDataError, OatGymError


def digest(folder: Path) -> str:
    """Return the SHA-256 of all files of a dataset, names included."""
    total = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            total.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return total.hexdigest()


def made(name: str, *, check: bool) -> tuple[str, str]:
    """Return the digest of a dataset made in an empty cache, and a line that says what it is."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["OAT_GYM_CACHE"] = cache
        data = domains.load(name)
        line = f"{data.total_episodes} episodes, {data.total_steps} steps"
        if check:
            line += f", {len(check_dataset(data).passed)} checks passed"
        return digest(Path(data.storage.data_path)), line


def examine(name: str) -> str:
    """Return a line on one dataset.

    Raises:
        OatGymError: if it fails a check, or the second build differs.
    """
    first, line = made(name, check=True)
    if made(name, check=False)[0] != first:
        raise InvalidDataError("The second build has other bytes.")
    return f"{line}, the same bytes twice"


def main() -> None:
    """Read the command line and examine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=sorted(domains.DATASETS), default=list(domains.DATASETS))
    failed = False
    for name in parser.parse_args().only:
        try:
            print(f"{name}: {examine(name)}", flush=True)
        except DatasetNotFoundError as error:
            print(f"{name}: not here. {error}", flush=True)
        except OatGymError as error:
            failed = True
            print(f"{name}: FAILED. {error}", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
