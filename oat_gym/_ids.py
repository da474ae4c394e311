"""What is said where a name is none: the form of a Minari id, and a name that is spelt nearly so."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def describe_ids(wrong: object) -> str:
    """Return the form of a Minari id, with the rule that `wrong` breaks although it looks right.

    >>> describe_ids("x/log-v0")
    "namespace/name-v0, with two characters or more in the namespace, and 'x' has one"
    """
    form = "namespace/name-v0"
    namespace, slash, _ = wrong.rpartition("/") if isinstance(wrong, str) else ("", "", "")
    if slash and len(namespace) == 1:
        return f"{form}, with two characters or more in the namespace, and {namespace!r} has one"
    return f"{form} (the namespace may be left out)"


def did_you_mean(wrong: str, names: Iterable[str]) -> str:
    """Return a question that names what `wrong` may stand for, after a space; nothing where no name is near.

    >>> did_you_mean("maze2d-umze", ["adroit-pen", "maze2d-umaze"])
    " Did you mean 'maze2d-umaze'?"
    """
    near = difflib.get_close_matches(wrong, list(names), n=1, cutoff=0.75)
    return f" Did you mean {near[0]!r}?" if near else ""
