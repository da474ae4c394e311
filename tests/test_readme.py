"""The README's Python blocks run as they stand."""

import re
from pathlib import Path

import pytest

from oat_gym import augmenters
from oat_gym.augmenters import oat
from oat_gym.generation import BehaviorConfig, VAEMDPConfig

README = (Path(__file__).parents[1] / "README.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.filterwarnings("ignore:.*hold no window")  # the maze has a few very short episodes
@pytest.mark.parametrize("block", BLOCKS, ids=[f"block{i}" for i in range(len(BLOCKS))])
def test_block(block: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    _write_log(tmp_path / "log.csv")
    # Short training: whether the lines are right does not depend on it.
    _shorten(monkeypatch)
    exec(compile(block, "README.md", "exec"), {})


def _write_log(path: Path) -> None:
    """Write the table that a block reads: three stays of 30 hours."""
    rows = [f"{stay},{hour},{80 + hour},{1.5},{(stay + hour) % 2},{0.1}" for stay in range(3) for hour in range(30)]
    path.write_text("\n".join(["stay,hour,pulse,lactate,fluids,reward", *rows]) + "\n")


def _shorten(monkeypatch: pytest.MonkeyPatch) -> None:
    original = oat.OAT.fit

    def quick(self: augmenters.OAT, *args: object, **kwargs: object) -> object:
        object.__setattr__(self, "model", VAEMDPConfig(max_updates=5))
        object.__setattr__(self, "behavior", BehaviorConfig(max_updates=20))
        return original(self, *args, **kwargs)

    monkeypatch.setattr(oat.OAT, "fit", quick)


def test_the_two_commands_are_marked_for_the_gate() -> None:
    for name in ("demo-command", "test-command"):
        assert README.count(f"<!-- {name} -->\n```bash\n") == 1
