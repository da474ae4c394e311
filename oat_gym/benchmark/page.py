"""`oat-gym report`: one HTML page without any link to the outside, for readers who know the domain."""

from __future__ import annotations

import base64
import re
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jinja2

from oat_gym.benchmark import story
from oat_gym.benchmark.analysis import MEAN, Analysis
from oat_gym.benchmark.captions import USES, budget_lines
from oat_gym.benchmark.estimates import estimates_table
from oat_gym.benchmark.grid import format_number
from oat_gym.benchmark.results import Results, read_results
from oat_gym.benchmark.scores import METRICS
from oat_gym.benchmark.tables import all_tables, dataset_table
from oat_gym.cache import Arrays, write_atomically

TEMPLATE = "page.html.jinja"


def write_page(folder: Path, path: Path, *, pictures: Path | None = None) -> Path:
    """Write the report of a folder of results to `path`, and its pictures as PNG files into a folder; return the path.

    Raises:
        ConfigurationError: where nothing was run in the folder.
        OSError: if the disk refuses.
    """
    settings = [_setting(each) for each in read_results(folder)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, _render(settings).encode())
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        for number, picture in enumerate(dict.fromkeys(_pictures(settings))):
            name = re.sub(r"[^a-z0-9]+", "-", picture.alt.lower())[:60].strip("-")
            write_atomically(pictures / f"{number:02d}-{name}.png", base64.b64decode(picture.data))
    return path


def make_page(results: tuple[Results, ...]) -> str:
    """Return the page of one or more settings as HTML."""
    return _render([_setting(each) for each in results])


def _pictures(part: Any) -> Iterator[story.Picture]:
    """Give the pictures of the page in the order of its parts."""
    if isinstance(part, story.Picture):
        yield part
    elif isinstance(part, dict | list | tuple):
        for each in part.values() if isinstance(part, dict) else part:
            yield from _pictures(each)


def _render(settings: list[dict[str, Any]]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    template = environment.get_template(TEMPLATE)
    made = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return template.render(made=made, settings=settings, metrics=METRICS, uses=USES)


def _setting(results: Results) -> dict[str, Any]:
    analysis = Analysis(results)
    groups = story.groups_of(analysis)
    seeds = sorted({cell.seed for cell in results.cells if not cell.failed})
    return {
        "describe": results.setting.describe(),
        "quick": results.setting.budget == "quick",
        "budget_lines": budget_lines(results),
        "seeds": seeds,
        "all_failed": analysis.failed(),
        "warnings": _warnings(results),
        "families": results.families,
        "n_cells": len(results.cells),
        "unfinished": results.unfinished,
        "missing": results.missing,
        "failed": _failed(results),
        "groups": [_group(analysis, group, level) for group, level in groups],
        "levels": story.by_level(analysis),
        "datasets": [_dataset(analysis, name) for name in results.datasets if name not in analysis.failed()],
        "n_findings": sum(found.improvement.decides for found in analysis.all_findings()),
        "doubts": _doubts(analysis),
        "costs": _costs(results),
        "environments": _environments(results),
        "commands": [manifest["command"] for manifest in results.manifests],
        "tables": all_tables(analysis),
    }


def _group(analysis: Analysis, group: story.Group, level: str | None) -> dict[str, Any]:
    return {
        "title": group[0],
        "datasets": group[1],
        "rows": story.summary_rows(analysis, group),
        "sentences": story.best_sentences(analysis, group),
        "bars": story.bars(analysis, group, level=level),
    }


def _dataset(analysis: Analysis, name: str) -> dict[str, Any]:
    results = analysis.results
    made = [(arrays, value) for arrays, value in results.augmented if value["dataset"] == name]
    made.sort(key=lambda pair: _order(results, pair[1]))
    real = made[0][1]["real"] if made else None
    known = name in analysis.with_truth()
    cell = next((cell for cell in results.cells if cell.dataset == name and not cell.failed), None)
    return {
        "name": name,
        "real": real,
        "policies": () if cell is None else cell.policies,
        "gamma": None if cell is None else cell.record["gamma"],
        "horizon": None if cell is None else cell.record["horizon"],
        "initial": "" if cell is None else cell.initial,
        "truth_note": "" if cell is None else cell.record["truth_note"],
        "knows_truth": known,
        "mined": _mined(made),
        "generated": [_generated(value) for _, value in _first_seeds(made) if value["synthetic"] is not None],
        "coverage": _coverage(made),
        "table": dataset_table(analysis, name) if known else estimates_table(analysis, name),
        "floor": story.floor_sentence(analysis, name),
        "truth_picture": story.truth_picture(analysis, name) if known else None,
        "returns": story.returns_picture(analysis, name) if known else None,
        "agreement": next((story.agreement_picture(v) for _, v in made if v.get("agreement")), None),
        "families": _family_bars(analysis, name) if known else [],
    }


def _order(results: Results, value: Mapping[str, Any]) -> tuple[int, int]:
    names = list(results.variants)
    return names.index(value["variant"]) if value["variant"] in names else len(names), int(value["seed"])


def _first_seeds(made: list[tuple[Arrays, dict[str, Any]]]) -> list[tuple[Arrays, dict[str, Any]]]:
    """Return the first seed of each variant."""
    first: dict[str, tuple[Arrays, dict[str, Any]]] = {}
    for pair in made:
        first.setdefault(pair[1]["variant"], pair)
    return list(first.values())


def _mined(made: list[tuple[Arrays, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Return what each variant that mines found, for its first seed."""
    rows: list[dict[str, Any]] = []
    for _, value in _first_seeds(made):
        if value["mining"] is not None:
            picture = story.support_picture(value["mining"])
            rows.append({"variant": value["variant"], "seed": value["seed"], "picture": picture} | value["mining"])
    return rows


def _generated(value: Mapping[str, Any]) -> dict[str, Any]:
    made, real = value["synthetic"], value["real"]
    spread = [f"{format_number(part['returns'][2])} ({format_number(part['returns'][1])} to "
              f"{format_number(part['returns'][3])})" for part in (real, made)]  # fmt: skip
    return {
        "variant": value["variant"],
        "note": value["note"],
        "episodes": made["episodes"],
        "share": f"{100 * made['generated_steps'] / max(made['steps'], 1):.0f}%",
        "untouched": made["untouched"],
        "real_returns": spread[0],
        "returns": spread[1],
        "seam": "-" if made["seams"] is None else format_number(made["seams"][2]),
        "seconds": format_number(value["cost"]["cpu_seconds"]),
    }


def _coverage(made: list[tuple[Arrays, dict[str, Any]]]) -> list[story.Picture]:
    """Return pictures of at most two variants: OAT's first."""
    there = [pair for pair in _first_seeds(made) if pair[1]["synthetic"] is not None]
    there.sort(key=lambda pair: not pair[1]["variant"].startswith("oat"))
    return [story.coverage_picture(*pair) for pair in there[:2]]


def _family_bars(analysis: Analysis, name: str) -> list[story.Picture]:
    pictures = [story.bars(analysis, (f"{name}, {family} alone", [name]), family=family)
                for family in analysis.results.families]  # fmt: skip
    return [picture for picture in pictures if picture is not None]


def _failed(results: Results) -> list[dict[str, str]]:
    """Return the failures, one row for each reason, with the cells that have it."""
    reasons: dict[str, list[str]] = {}
    for cell in results.cells:
        if cell.failed:
            where = f"{cell.dataset}, {cell.variant}, {cell.family}, seed {cell.seed}"
            reasons.setdefault(cell.reason, []).append(where)
    return [{"reason": reason, "cells": "; ".join(cells)} for reason, cells in reasons.items()]


def _warnings(results: Results) -> list[tuple[str, int]]:
    """Return what estimators warned of, numbers left out, and in how many cells; the commonest first."""
    counts: dict[str, int] = {}
    for cell in results.cells:
        texts = {re.sub(r"-?\d[\d.,]*(e[+-]?\d+)?", "#", text) for text in cell.record.get("warnings", ())}
        for text in texts:
            counts[text] = counts.get(text, 0) + 1
    return sorted(counts.items(), key=lambda pair: (-pair[1], pair[0]))


def _doubts(analysis: Analysis) -> list[tuple[str, int]]:
    """Return how often each source of uncertainty is the largest, of the means over estimators, the commonest first."""
    counts: dict[str, int] = {}
    for found in analysis.all_findings():
        if found.family == MEAN and found.improvement.decides:
            counts[found.improvement.parts.main] = counts.get(found.improvement.parts.main, 0) + 1
    return sorted(counts.items(), key=lambda pair: -pair[1])


def _costs(results: Results) -> list[dict[str, str]]:
    """Return CPU seconds and memory of each estimator: median and maximum over its cells."""
    rows: list[dict[str, str]] = []
    for family in results.families:
        costs = [cell.record["cost"] for cell in results.cells if cell.family == family and "cost" in cell.record]
        if costs:
            seconds = sorted(float(cost["cpu_seconds"]) for cost in costs)
            memory = max(float(cost["peak_memory_mb"]) for cost in costs)
            numbers = (seconds[len(seconds) // 2], seconds[-1], memory)
            rows.append(
                {"family": family} | dict(zip(("median", "most", "memory"), map(format_number, numbers), strict=True))
            )
    return rows


def _environments(results: Results) -> list[str]:
    """Return the different environments that cells were computed in."""
    texts = {
        ", ".join(f"{name} {value}" for name, value in cell.record["environment"].items() if value)
        for cell in results.cells
    }
    return sorted(texts)
