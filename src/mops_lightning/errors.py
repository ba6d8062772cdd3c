"""The one error that a user's mistake ends in, and the words that it is made of."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(ValueError):
    """A mistake in settings, files or arguments; the command line prints it without a traceback."""


class Interrupted(Exception):
    """A run was stopped by a signal.

    Not a KeyboardInterrupt: Lightning turns that into ``SystemExit(1)`` and hides what happened.
    """


def did_you_mean(name: str, allowed: Iterable[str]) -> str:
    """Say which allowed names are nearest to ``name``, and all of them when they are few.

    Args:
        name: what came.
        allowed: what would have been accepted.

    Returns:
        A phrase that starts with a space, to be put behind an error's first sentence.
    """
    names = sorted(allowed)
    close = get_close_matches(name, names, n=3, cutoff=0.5)
    hint = f" Did you mean {' or '.join(repr(c) for c in close)}?" if close else ""
    listed = f" Allowed: {', '.join(names)}." if len(names) <= 40 else ""
    return hint + listed
