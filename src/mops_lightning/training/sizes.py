"""Which sizes a run tests."""

from collections.abc import Sequence

from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler

STANDARD = (8, 16, 32, 64, 128, 256, 512)
"""The sizes of the paper's tables."""
AUTO = "auto"


def sizes_to_test(
    sizes: str | Sequence[int],
    m: int,
    sampler: Sampler | None,
    n_points: int,
    training: bool = True,
) -> tuple[int, ...]:
    """Return how many points the test asks the sampler for, in ascending order.

    Args:
        sizes: ``auto`` tests a learned sampler of many sizes at the standard ones, as far as it
            and the clouds go, and any other at ``m`` alone. A list is taken as it is.
        m: the size that the run is about; it is always tested.
        sampler: None where only the task net learns.
        n_points: N of the test clouds.
        training: whether the sampler learns, which it does at its largest size too.

    Raises:
        UserError: a size that the sampler or the clouds do not allow.
    """
    if sampler is None:
        return ()
    if sampler.learned:
        _check_largest(sampler, m, n_points, training)
    if sizes == AUTO:
        if m > n_points:
            raise UserError(f"m must be at most the {n_points} points of a cloud, got m={m}.")
        most = min(sampler.m, n_points)
        more = STANDARD if sampler.flexible and sampler.learned else ()
        return tuple(sorted({m, *(size for size in more if size <= most)}))
    wanted = sorted({m, *map(int, sizes)})
    if not sampler.flexible and wanted != [m]:
        raise UserError(
            f"sizes: this sampler returns {m} points only, got sizes={list(sizes)}. "
            "Train one that returns any number, such as sampler=fmops, or run with -m m=8,16,32."
        )
    if wanted[0] < 1 or wanted[-1] > n_points:
        raise UserError(
            f"sizes must be from 1 to the {n_points} points of a cloud, got {list(sizes)}."
        )
    if sampler.learned and wanted[-1] > sampler.m:
        raise UserError(
            f"sizes must be at most sampler.m_max={sampler.m}, which this net was made for, "
            f"got {list(sizes)}."
        )
    return tuple(wanted)


def _check_largest(sampler: Sampler, m: int, n_points: int, training: bool) -> None:
    if m > sampler.m:
        raise UserError(
            f"m must be at most sampler.m_max={sampler.m}, got m={m}. "
            f"Lower m, or train with sampler.m_max={m}."
        )
    if training and sampler.m > n_points:
        name = "sampler.m_max" if sampler.flexible else "m"
        raise UserError(
            f"{name} must be at most the {n_points} points of a cloud, got {sampler.m}. "
            f"Try {name}={n_points}, or clouds of more points (dataset.n_points; for pairs also "
            "task.pairs.resample and task.pairs.overlap)."
        )
