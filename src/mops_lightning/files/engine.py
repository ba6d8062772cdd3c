"""Engines: where the ranges of a file's rows are processed."""

import sys
from collections.abc import Callable, Iterable
from typing import Any, Protocol

from rich.progress import track


class Engine(Protocol):
    """Calls a function for ranges of rows, in this process or elsewhere."""

    def map(
        self, title: str, function: Callable[[range], Any], row_ranges: list[range]
    ) -> Iterable[Any]:
        """Return ``function(rows)`` for every range of rows, in order.

        Args:
            title: name of the step, for progress and errors.
            function: can be pickled, such as a ``partial`` of a function of a module.
            row_ranges: ranges of rows, which are independent of each other.
        """


class LocalEngine:
    """Processes one range after the other in this process.

    Args:
        progress: show the progress on a terminal.
    """

    def __init__(self, progress: bool = False) -> None:
        self.progress = progress

    def map(
        self, title: str, function: Callable[[range], Any], row_ranges: list[range]
    ) -> Iterable[Any]:
        """See ``Engine.map``."""
        results = map(function, row_ranges)
        return with_progress(results, title, len(row_ranges)) if self.progress else results


def with_progress(results: Iterable[Any], title: str, total: int) -> Iterable[Any]:
    """Pass results on, and show the progress on a terminal."""
    hidden = not sys.stdout.isatty()
    return track(results, title, total=total, disable=hidden, transient=True)
