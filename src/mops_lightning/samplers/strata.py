"""How a number of points is shared among classes."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError


def share_among_classes(
    counts: Mapping[int, int],
    m: int,
    least: int | None = None,
    prefix: str = "",
) -> dict[int, int]:
    """Share m points among classes.

    Args:
        counts: number of points of every class, m or more in total.
        m: number of points to keep.
        least: number of points that every class keeps where it has them; None: its share.
        prefix: of the names of arguments in errors.

    Returns:
        A number for every class, at most its points; their sum is m. Shares are rounded by the
        method of the largest remainder.

    Raises:
        UserError: the least numbers of all classes are more than m.
    """
    given = dict.fromkeys(sorted(counts), 0)
    if least is not None:
        for name in given:
            given[name] = min(least, counts[name])
    needed = sum(given.values())
    if needed > m:
        raise UserError(
            f"{prefix}stratify: {least} points of each of the {len(counts)} classes are "
            f"{needed}, more than {prefix}m {m}."
        )
    total = sum(counts.values())
    wanted = {}
    for name in given:
        share = m * counts[name] / total
        wanted[name] = max(share, given[name])
    return _rounded(given, wanted, counts, m)


def _rounded(
    given: dict[int, int],
    wanted: dict[int, float],
    counts: Mapping[int, int],
    m: int,
) -> dict[int, int]:
    """Add points to the classes that lack most of what they are to have, until there are m."""
    open_classes = {name for name in given if wanted[name] > given[name]}
    left = m - sum(given.values())
    missing_of = {name: wanted[name] - given[name] for name in open_classes}
    spare = sum(missing_of.values())
    shares = dict(given)
    remainders: dict[int, float] = {}
    if spare:
        # Where some classes keep more than their share, the others give in proportion.
        for name in open_classes:
            more = left * missing_of[name] / spare
            shares[name] += int(more)
            remainders[name] = given[name] + more - shares[name]
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
