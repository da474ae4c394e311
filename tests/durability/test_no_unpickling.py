"""Nothing is unpickled and no text is run: the package's own source is searched for every way to do so."""

import ast
from pathlib import Path

import pytest

import oat_gym

MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "marshal", "shelve", "jsonpickle", "yaml", "runpy", "code"}
CALLS = {"eval", "exec", "compile", "__import__", "execfile"}
METHODS = {
    ("torch", "load"),
    ("torch", "save"),
    ("joblib", "load"),
    ("joblib", "dump"),
    ("pd", "read_pickle"),
    ("pandas", "read_pickle"),
    ("importlib", "import_module"),
    ("os", "system"),
    ("os", "popen"),
}


# What never sees data from a file: the copies that `check_dataset` and `check_augmenter` make of objects in memory, and
# optional packages that are imported by their fixed names.
ALLOWED = {
    "checks/_access.py": {"import pickle"},
    "checks/_augmenter_settings.py": {"import pickle"},
    "io/consumers.py": {"importlib.import_module"},
}


def forbidden(source: str) -> list[str]:
    """Return what in a module could turn data into code."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Call):
            found += _in_call(node)
            continue
        else:
            continue
        found += [f"import {name}" for name in names if name.split(".")[0] in MODULES]
    return found


def _in_call(node: ast.Call) -> list[str]:
    function = node.func
    keywords = {word.arg: word.value for word in node.keywords}
    allowed = keywords.get("allow_pickle")
    problems: list[str] = []
    if isinstance(function, ast.Name) and function.id in CALLS:
        problems.append(function.id)
    if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name):
        name = (function.value.id, function.attr)
        if name in METHODS:
            problems.append(".".join(name))
        if name in {("np", "load"), ("numpy", "load")} and allowed is None:
            problems.append("np.load without allow_pickle=False")
    if allowed is not None and not (isinstance(allowed, ast.Constant) and allowed.value is False):
        problems.append("allow_pickle")
    return problems


PACKAGE = Path(oat_gym.__file__).parent


@pytest.mark.parametrize("name", sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")))
def test_no_module_can_turn_data_into_code(name: str) -> None:
    assert set(forbidden((PACKAGE / name).read_text())) <= ALLOWED.get(name, set())


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from pickle import loads",
        "import torch\ntorch.load('x')",
        "np.load('x')",
        "np.load('x', allow_pickle=True)",
        "np.load('x', allow_pickle=wanted)",
        "eval('1')",
        "exec(text)",
        "import joblib\njoblib.load('x')",
        "importlib.import_module(name)",
    ],
)
def test_the_search_finds_what_it_looks_for(source: str) -> None:
    assert forbidden(source)


def test_the_search_lets_pass_what_is_safe() -> None:
    assert not forbidden("import numpy as np\nwith np.load('x', allow_pickle=False) as file:\n    model.eval()\n")
