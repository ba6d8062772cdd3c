"""The sample sizes that a run tests."""

from collections.abc import Mapping, Sequence

from mops_lightning.errors import UserError
from mops_lightning.samplers.base import Sampler

STANDARD_SIZES = (8, 16, 32, 64, 128, 256, 512)
"""The sizes of the paper's tables."""
AUTO = "auto"
MORE_POINTS = (
    "Lower it, or give clouds of more points (dataset.n_points; for pairs also task.resample)."
)


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
    if sizes == AUTO:
        _check_largest({"m": m}, sampler, n_points, training)
        return _usual_sizes(m, sampler, n_points)
    listed = [int(size) for size in sizes]
    wanted = tuple(sorted({m, *listed}))
    if not sampler.flexible and wanted != (m,):
        raise UserError(
            f"sizes: this sampler returns {m} points only, got sizes={listed}. "
            "Train one that returns any number, such as sampler=fmops, or run with -m m=8,16,32."
        )
    _check_largest({"m": m, "sizes": wanted[-1]}, sampler, n_points, training)
    return wanted


def _usual_sizes(m: int, sampler: Sampler, n_points: int) -> tuple[int, ...]:
    """Return ``m``, and the standard sizes that a multi-size sampler and the clouds allow."""
    is_multi_size = sampler.flexible and sampler.learned
    if not is_multi_size:
        return (m,)
    largest = min(sampler.m, n_points)
    standard = [size for size in STANDARD_SIZES if size <= largest]
    return tuple(sorted({m, *standard}))


def _check_largest(
    largest: Mapping[str, int], sampler: Sampler, n_points: int, training: bool
) -> None:
    """Refuse sizes that the sampler or the clouds do not allow.

    Args:
        largest: the largest size that a setting requests, by its name.
        sampler: the sampler.
        n_points: N of the test clouds.
        training: whether the sampler is trained, which includes its largest size.

    Raises:
        UserError: a size is too large.
    """
    requested = dict(largest)
    if sampler.learned and training:
        requested["sampler.m_max"] = sampler.m
    for name, size in requested.items():
        if size > n_points:
            raise UserError(
                f"{name} must be at most the {n_points} points of a cloud, got {size}. "
                f"{MORE_POINTS}"
            )
        if sampler.learned and size > sampler.m:
            raise UserError(
                f"{name} must be at most sampler.m_max={sampler.m}, got {size}. "
                f"Lower it, or train with sampler.m_max={size}."
            )
