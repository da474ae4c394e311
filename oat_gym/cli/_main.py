"""The entry point: errors as one line, exit statuses, and what belongs to no command."""

from __future__ import annotations

import logging
import sys
import warnings

import typer

import oat_gym
from oat_gym.cli._shared import app, out
from oat_gym.errors import OatGymError

_WRONG_USAGE: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
"""What wrong arguments raise; typer has no public name for it."""


def main() -> None:
    """Run the command line: status 0 when it went well, 2 with one line on bad input, 130 when interrupted."""
    logging.basicConfig(level=logging.WARNING, format="oat-gym: %(message)s", stream=sys.stderr)
    warnings.simplefilter("ignore", DeprecationWarning)
    warnings.showwarning = lambda message, *_: _complain(str(message))
    try:
        app(sys.argv[1:] or ["--help"], standalone_mode=False)
    except (OatGymError, OSError) as error:
        _complain(str(error))
        sys.exit(2)
    except _WRONG_USAGE as error:
        _complain(getattr(error, "format_message", error.__str__)())
        sys.exit(2)
    except KeyboardInterrupt:
        print("oat-gym: interrupted; what was finished is kept.", file=sys.stderr)
        sys.exit(130)


def _complain(message: str) -> None:
    print(f"oat-gym: {' '.join(message.split())}", file=sys.stderr)


def about() -> None:
    """Make a small offline-RL dataset larger, in a way that helps off-policy evaluation."""


def version() -> None:
    """Print the version."""
    out.print(oat_gym.__version__)
