"""Sharing a number of points among the files of a folder (``--total``)."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from mops_lightning.errors import UserError, one_line
from mops_lightning.files.options import Options
from mops_lightning.samplers.budget import number_of
from mops_lightning.samplers.strata import share_among_classes


class Job(NamedTuple):
    """One file to downsample: its input, its output, and how."""

    source: Path
    target: Path
    options: Options


class Shared(NamedTuple):
    """Files to downsample, each to its share of the points.

    Attributes:
        jobs: of the files that have points.
        failures: the errors of the others, by their path.
    """

    jobs: list[Job]
    failures: dict[Path, UserError]


def share_total(jobs: list[Job]) -> Shared:
    """Share the number of points to keep among the files, in proportion to their points.

    Every file keeps at least one point. Files that cannot be counted take no part.

    Raises:
        UserError: there are fewer points to keep than files, or fewer points in the files.
    """
    counted: list[Job] = []
    sizes: list[int] = []
    failures: dict[Path, UserError] = {}
    for job in jobs:
        try:
            sizes.append(_count(job))
            counted.append(job)
        except UserError as error:
            failures[job.source] = error
        except Exception as error:
            failures[job.source] = UserError(f"{job.source}: {one_line(error)}.")
    if not counted:
        return Shared([], failures)
    shared = []
    numbers = _numbers(jobs[0].options, sizes)
    for job, number in zip(counted, numbers, strict=True):
        options = replace(job.options, m=number)
        shared.append(job._replace(options=options))
    return Shared(shared, failures)


def _count(job: Job) -> int:
    from mops_lightning.files.downsample import count_points

    number = count_points(job.source, job.options)
    if not number:
        raise UserError(f"{job.source} holds no points.")
    return number


def _numbers(options: Options, sizes: list[int]) -> list[int]:
    """Return how many points to keep of files with so many points."""
    from mops_lightning.samplers.tiles import shares

    assert options.m is not None
    points = sum(sizes)
    total = number_of(options.m, points)
    if not len(sizes) <= total <= points:
        raise UserError(
            f"--total: the {len(sizes)} files hold {points:,} points; --m must be from one "
            f"point per file to that number, got {total:,}."
        )
    numbers: list[int] = shares(total, sizes).tolist()
    if 0 not in numbers:
        return numbers
    number_of_file = share_among_classes(dict(enumerate(sizes)), total, least=1)
    return [number_of_file[place] for place in range(len(sizes))]
