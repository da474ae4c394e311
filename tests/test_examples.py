"""Every example runs, and stays short."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("[0-9]*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_example(path: Path, tmp_path: Path) -> None:
    assert len(path.read_text().splitlines()) < 80
    here = tmp_path / "here"
    here.mkdir()
    with tempfile.TemporaryDirectory(prefix="ex-") as temporary:  # short: sockets of worker processes lie in it
        run = subprocess.run(
            [sys.executable, str(path)],
            cwd=here,
            env={**os.environ, "TMPDIR": temporary, "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "torch")},
            capture_output=True,
            text=True,
            check=False,
        )
        left = [*here.iterdir(), *Path(temporary).iterdir()]
    assert run.returncode == 0, run.stderr
    assert run.stdout
    assert not left
