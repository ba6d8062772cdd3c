"""Classes of points, and how a number of points is shared among them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError

SHORT = {"class": "classification"}
"""Names of columns in LAS files that have a shorter name elsewhere."""


@dataclass(frozen=True)
class Strata:
    """How the points of each class are kept.

    Attributes:
        column: of whole numbers, the classes.
        least: number of points that every class keeps where it has them; None: its share.
    """

    column: str
    least: int | None = None

    @classmethod
    def parse(cls, text: str) -> "Strata":
        """Return the strata of a command line: ``COLUMN:share`` or ``COLUMN:min=NUMBER``."""
        column, _, rule = text.rpartition(":")
        number = rule.removeprefix("min=")
        if column and rule == "share":
            return cls(column)
        if column and rule != number and number.isdecimal() and int(number) > 0:
            return cls(column, int(number))
        raise UserError(
            "--stratify must be a column and a rule, such as class:share or class:min=50, got "
            f"{text!r}."
        )

    def classes(self, table: Table, path: Path) -> NDArray[np.int64]:
        """Return the class ``(N,)`` of every point."""
        name = self.column
        if name not in table.columns:
            name = SHORT.get(name, name)
        return table.whole_numbers(name, path)

    def numbers(self, counts: Mapping[int, int], m: int) -> dict[int, int]:
        """Share m points among classes.

        Args:
            counts: number of points of every class, m or more in total.
            m: number of points to keep.

        Returns:
            A number for every class, at most its points; their sum is m. Shares are rounded by the
            method of the largest remainder.

        Raises:
            UserError: the least numbers of all classes are more than m.
        """
        given = dict.fromkeys(sorted(counts), 0)
        if self.least is not None:
            given = {name: min(self.least, counts[name]) for name in given}
        left = m - sum(given.values())
        if left < 0:
            raise UserError(
                f"--stratify: {self.least} points of each of the {len(counts)} classes are "
                f"{m - left}, more than --m {m}."
            )
        total = sum(counts.values())
        wanted = {name: max(m * counts[name] / total, given[name]) for name in given}
        return _rounded(given, wanted, counts, m)


def _rounded(
    given: dict[int, int], wanted: dict[int, float], counts: Mapping[int, int], m: int
) -> dict[int, int]:
    """Add points to the classes that lack most of what they are to have, until there are m."""
    open_classes = {name for name in given if wanted[name] > given[name]}
    left = m - sum(given.values())
    spare = sum(wanted[name] - given[name] for name in open_classes)
    shares = dict(given)
    if spare:
        # Where some classes keep more than their share, the others give in proportion.
        for name in open_classes:
            shares[name] += int(left * (wanted[name] - given[name]) / spare)
    remainders = {
        name: given[name] + left * (wanted[name] - given[name]) / spare - shares[name]
        for name in open_classes
        if spare
    }
    by_remainder = sorted(remainders, key=lambda name: (-remainders[name], name))
    others = [name for name in given if name not in remainders]
    missing = m - sum(shares.values())
    while missing:
        for name in (*by_remainder, *others):
            if missing and shares[name] < counts[name]:
                shares[name] += 1
                missing -= 1
    return shares


def count_classes(classes: NDArray[np.int64]) -> dict[int, int]:
    """Return the number of points of every class."""
    names, counts = np.unique(classes, return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))
