"""Run Minari's own test-suite against oat_gym, and compare with what it does without.

    python tests/minari_suite/run.py --checkout DIR

DIR is a checkout of https://github.com/Farama-Foundation/Minari; the Minari that is tested is the installed one. The
tests need `pip install "minari[create]" scikit-image` beside oat_gym's own test dependencies. Three runs (baseline,
wrapped, storage; see `plugin.py`) are made, and the exit status is 1 if one of the last two fails a test that the
baseline passes. LEFT_OUT says what is not run and why, EXPLAINED what fails for a reason that is none of oat_gym's.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

LEFT_OUT = {
    "integrations": "needs TorchRL, d3rlpy and AgileRL",
    "test_docs.py": "runs the documentation, which downloads",
    "test_cli.py": "lists and downloads remote datasets when it is collected",
    "dataset/test_dataset_download.py": "downloads",
}
EXPLAINED = {
    ("wrapped", "test_missing_env_module"): "writes to storage.data_path, which is ours, and loads by id what is there",
}


def main() -> int:
    """Parse the arguments, run, print a table; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, required=True, help="a checkout of Minari's repository")
    parser.add_argument("--modes", nargs="+", default=["baseline", "wrapped", "storage"])
    parser.add_argument("pytest_args", nargs="*", help="more arguments for pytest, after --")
    arguments = parser.parse_args()
    results = {mode: run(arguments.checkout, mode, arguments.pytest_args) for mode in arguments.modes}
    for name, reason in LEFT_OUT.items():
        print(f"left out: tests/{name} ({reason})")
    baseline = results.get("baseline", {})
    worse = False
    for mode, outcomes in results.items():
        counts = {kind: list(outcomes.values()).count(kind) for kind in ("passed", "failed", "skipped")}
        print(f"{mode}: " + ", ".join(f"{count} {kind}" for kind, count in counts.items()))
        for name, outcome in outcomes.items():
            if outcome == "failed":
                known = "the baseline fails it too" if baseline.get(name) == "failed" else _explanation(mode, name)
                worse |= not known
                print(f"  failed: {name}" + (f" ({known})" if known else ""))
    return int(worse or any(not outcomes for outcomes in results.values()))


def run(checkout: Path, mode: str, pytest_args: list[str]) -> dict[str, str]:
    """Return the outcome of each test in one mode: passed, failed or skipped."""
    with tempfile.TemporaryDirectory() as folder:
        # The tests alone, so that `import minari` finds the installed package.
        shutil.copytree(checkout / "tests", Path(folder) / "tests")
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "tests", "-q", "-p", "plugin", "--oat-gym-mode", mode]
        command += ["-p", "no:cacheprovider", "--junit-xml", str(report), "--tb", "short", *pytest_args]
        command += [f"--ignore=tests/{name}" for name in LEFT_OUT]
        paths = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        subprocess.run(
            command, cwd=folder, check=False, env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
        )
        return {} if not report.exists() else dict(map(_outcome, ET.parse(report).iter("testcase")))


def _explanation(mode: str, name: str) -> str:
    reasons = (reason for (where, test), reason in EXPLAINED.items() if where == mode and f"::{test}[" in name)
    return next(reasons, "")


def _outcome(case: ET.Element) -> tuple[str, str]:
    kinds = {child.tag for child in case}
    kind = "failed" if kinds & {"failure", "error"} else "skipped" if "skipped" in kinds else "passed"
    return f"{case.get('classname')}::{case.get('name')}", kind


if __name__ == "__main__":
    sys.exit(main())
