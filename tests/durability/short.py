"""The short form of `kill.py` and `crowd.py`, in one process, for continuous integration. Prints a JSON summary."""

import json
import sys
import tempfile
from pathlib import Path

import crowd
import kill


def main() -> int:
    """Kill six times at random moments and thrice before changes of the file system; let eight processes compete."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        harness = kill.Harness(folder / "kill", list(kill.JOBS))
        summary = {
            "random": kill.run(harness, kills=6, seed=0, what="all"),
            "steps": kill.run(harness, kills=3, seed=0, what="all", at="steps"),
            "crowd": crowd.run(folder / "crowd", processes=8),
        }
    print(json.dumps(summary))
    return 0


if __name__ == "__main__":
    sys.exit(main())
