"""``--stratify``: a column of classes, and how a number of points is shared among them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.samplers.strata import share_among_classes

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
        is_number = rule != number and number.isdecimal()
        if column and is_number and int(number) > 0:
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
        """Share m points among classes; see ``share_among_classes``."""
        return share_among_classes(counts, m, self.least, "--")
