"""The sizes that a run tests."""

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
    """Return the sizes that are tested, in ascending order.

    Args:
        sizes: ``auto`` tests a flexible learned sampler at those standard sizes that it and the
            clouds allow, any other sampler at ``m`` alone. A list is used as given.
        m: the run's own size, which is always tested.
        sampler: None where only the task net learns.
        n_points: N of the test clouds.
        training: whether the sampler is trained, which includes its largest size.

    Raises:
        UserError: the sampler or the clouds do not allow a size.
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
            f"sizes must be at most sampler.m_max={sampler.m}, the largest size of this net, "
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
            "task.pairs.resample)."
        )
