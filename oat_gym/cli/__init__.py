"""The command line `oat-gym`: one file a command, listed here in the order of the help."""

from oat_gym.cli import augment, bench, cache, compare, demo, evaluate, inspect, report
from oat_gym.cli._main import about, main, version
from oat_gym.cli._shared import app, configure, open_source

app.callback()(about)
for _command in (
    version,
    demo.demo,
    augment.augment,
    inspect.inspect,
    compare.compare,
    evaluate.evaluate,
    bench.bench,
    report.report,
):
    app.command()(_command)
app.add_typer(cache.cache_app, name="cache")

__all__ = [
    "app",
    "augment",
    "bench",
    "cache",
    "compare",
    "configure",
    "demo",
    "evaluate",
    "inspect",
    "main",
    "open_source",
    "report",
]
