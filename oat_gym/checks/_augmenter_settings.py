"""Checks of an augmenter's configuration: immutable, picklable, and rebuilt by its repr and by its JSON form."""

from __future__ import annotations

import ast
import dataclasses
import json
import pickle
from collections.abc import Iterator, Mapping
from typing import Any

from oat_gym.augmenters._parts import methods_in
from oat_gym.augmenters.base import Augmenter
from oat_gym.cache import canonical
from oat_gym.checks._trial import Trials
from oat_gym.checks.report import Broken, Check, NotApplicable
from oat_gym.errors import InvalidDataError
from oat_gym.recipe import METHODS
from oat_gym.serialization import config_from_json

_NEW = "not_a_setting"


def named(trials: Trials) -> int:
    """It has a name of its own."""
    augmenter = trials.augmenter
    name = getattr(augmenter, "name", None)
    if not isinstance(name, str) or not name:
        raise Broken(f"its name must be a string, got {name!r}: set `name: ClassVar[str]`")
    other = METHODS.get(name)
    if other is not None and other is not type(augmenter):
        raise Broken(f"its name {name!r} is that of {other.__name__}")
    return 1


def immutable(trials: Trials) -> int:
    """It is a frozen dataclass: no attribute can be set, and it has a hash."""
    augmenter = trials.augmenter
    kind = type(augmenter)
    if "__dataclass_params__" not in vars(kind):
        raise Broken(f"{kind.__name__} is no dataclass itself: decorate it by @dataclass(frozen=True)")
    fields = [field.name for field in dataclasses.fields(augmenter)]
    for name in fields:
        if _settable(augmenter, name, getattr(augmenter, name)):
            raise Broken(f"its setting {name!r} can be set after it was made")
    if _settable(augmenter, _NEW, None):
        delattr(augmenter, _NEW)
        raise Broken("new attributes can be set on it")
    try:
        hash(augmenter)
    except TypeError as error:
        raise Broken(
            f"it has no hash ({error}): settings are tuples, numbers, strings and frozen dataclasses"
        ) from None
    return len(fields) + 2


def _settable(augmenter: Augmenter, name: str, value: object) -> bool:
    try:
        setattr(augmenter, name, value)
    except AttributeError:  # FrozenInstanceError is one
        return False
    return True


def picklable(trials: Trials) -> int:
    """Unpickling its pickle gives an equal one."""
    try:
        text = pickle.dumps(trials.augmenter)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise Broken(f"it cannot be pickled, which loader workers need: {error}") from error
    twin = pickle.loads(text)  # noqa: S301  (what was pickled one line above)
    if twin != trials.augmenter:
        raise Broken(f"its pickle gives back {twin!r}")
    return 1


def rebuilt_by_repr(trials: Trials) -> int:
    """Its repr is a call that rebuilds it; the text is read and not run."""
    augmenter, text = trials.augmenter, repr(trials.augmenter)
    try:
        twin = _from_expression(ast.parse(text, mode="eval").body, _classes_in(augmenter))
    except (SyntaxError, ValueError, TypeError) as error:
        if not augmenter.cacheable:
            raise NotApplicable(f"a setting is code of the user's, which no text gives back ({error})") from None
        raise Broken(f"its repr {text} does not rebuild it: {error}") from None
    if twin != augmenter:
        raise Broken(f"its repr {text} rebuilds {twin!r}, which is not equal to it")
    return 1


def _from_expression(node: ast.expr, classes: Mapping[str, type[Any]]) -> Any:
    """Return what an expression of literals and of calls of the given classes stands for."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in classes and not node.args:
        settings = {word.arg: _from_expression(word.value, classes) for word in node.keywords if word.arg}
        return classes[node.func.id](**settings)
    if isinstance(node, ast.Tuple):
        return tuple(_from_expression(item, classes) for item in node.elts)
    return ast.literal_eval(node)


def _classes_in(value: object) -> dict[str, type[Any]]:
    return {type(part).__name__: type(part) for part in _dataclasses_in(value)}


def _dataclasses_in(value: object) -> Iterator[object]:
    if isinstance(value, tuple | list):
        for item in value:
            yield from _dataclasses_in(item)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield value
        for field in dataclasses.fields(value):
            yield from _dataclasses_in(getattr(value, field.name))


def rebuilt_by_json(trials: Trials) -> int:
    """Its settings as JSON, which recipes and the cache keep, rebuild it."""
    augmenter = trials.augmenter
    if not augmenter.cacheable:
        raise NotApplicable("cacheable is False: its settings have no JSON form, so no recipe or cache keeps them")
    known = {*METHODS.values(), *(type(method) for method in methods_in(augmenter))}
    try:
        text = json.dumps(canonical(augmenter))
        twin = config_from_json(type(augmenter), json.loads(text), known=tuple(known))
    except (TypeError, InvalidDataError) as error:
        raise Broken(f"{error} Give it settings that JSON gives back, or say `cacheable` False") from error
    if twin != augmenter:
        raise Broken(f"its settings as JSON, {text}, give back {twin!r}")
    return 1


SETTINGS_CHECKS: tuple[Check[Trials], ...] = (
    Check("named", "it has a name of its own", named),
    Check("immutable", "it is a frozen dataclass with a hash", immutable),
    Check("picklable", "its pickle is it", picklable, ("immutable",)),
    Check("repr", "its repr rebuilds it", rebuilt_by_repr, ("immutable",)),
    Check("settings", "its settings survive JSON", rebuilt_by_json, ("immutable",)),
)
