"""Downsampling clouds to numbers of points, one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mops_lightning.errors import UserError
from mops_lightning.ops.points import as_tensor
from mops_lightning.ops.scalars import is_whole_number, python_number
from mops_lightning.ops.weights import check_positive
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.budget import as_size, number_of
from mops_lightning.samplers.fps import FPSSampler, farthest_rows
from mops_lightning.samplers.poisson import poisson_rows
from mops_lightning.samplers.strata import count_classes, share_among_classes
from mops_lightning.samplers.tiles import sample_by_tiles
from mops_lightning.zoo.clouds import Cloud, Clouds, Sample
from mops_lightning.zoo.find_sampler import find_sampler


@dataclass(frozen=True)
class Choice:
    """How points are chosen; the attributes are arguments of ``downsample``."""

    method: str | Path
    readout: str
    start: int | str | None
    seed: int | None
    space: Any
    tile: int | None

    def check(self, weight: Any) -> None:
        """Check what the arguments demand of each other.

        Raises:
            UserError: they do not fit.
        """
        if self.space is not None:
            self._check_space()
        if self.tile is not None:
            self._check_tile(self.tile, weight)

    def _check_space(self) -> None:
        if self.method not in ("fps", "poisson"):
            raise UserError(
                "space is for method='fps', method='poisson' and spacing, got "
                f"{str(self.method)!r}."
            )
        if self.tile is not None:
            raise UserError("give space or tile, not both.")

    def _check_tile(self, tile: Any, weight: Any) -> None:
        if isinstance(tile, bool) or not isinstance(tile, int) or tile < 2:
            raise UserError(f"tile must be a whole number of at least 2, got {tile!r:.99}.")
        if weight is not None:
            raise UserError("weight needs the whole cloud at once: leave tile out.")
        if self.readout != "completed":
            raise UserError(f"tile keeps different input points: no readout {self.readout!r:.99}.")

    def sample(self, cloud: Cloud, number: int) -> Sample:
        """Downsample one cloud."""
        if self.space is not None:
            return self._sample_in_space(cloud, number)
        sampler = find_sampler(self.method, number, cloud.points, self.start, self.seed)
        if self.tile is not None:
            return self._sample_tiles(cloud, number, sampler, self.tile)
        channels = sampler.point_channels
        seen = cloud.coordinates
        if channels:
            seen = torch.cat([seen.double(), cloud.channels(channels)], 1)
        generated, rows = sampler.downsample(seen, number, self.readout, None, cloud.weight)
        if rows is not None:
            return cloud.points[rows], rows
        if channels:
            return cloud.in_its_type(generated), None
        if cloud.points.shape[1] > 3:
            raise UserError("generated points have coordinates only: give points[..., :3].")
        return generated, None

    def _sample_tiles(self, cloud: Cloud, number: int, sampler: Sampler, tile: int) -> Sample:
        channels = sampler.point_channels
        scaled = None
        if channels:
            scaled = channels.scaled(cloud.channels(channels)).float()
        places = cloud.columns()[:, :3]
        return cloud.rows(sample_by_tiles(places, tile, number, sampler, scaled))

    def _sample_in_space(self, cloud: Cloud, number: int) -> Sample:
        """Choose farthest points, or those of sample elimination, by the columns that count."""
        seed = self.seed or 0
        FPSSampler(number, seed, self.start)  # checks the start
        choose: Any = partial(farthest_rows, start=self.start)
        if self.method == "poisson":
            choose = poisson_rows
        used = np.ascontiguousarray(cloud.in_space(self.space))
        points = torch.from_numpy(used)[None]
        weight = cloud.numbers()
        if weight is None:
            chosen = choose(points, number, seed, in_sphere=True)[0]
            return cloud.rows(chosen.numpy())
        heavy = np.flatnonzero(weight)
        check_positive(len(heavy), number)
        weights = torch.from_numpy(weight[heavy])[None]
        heavy_points = points[:, heavy]
        chosen = choose(heavy_points, number, seed, weight=weights, in_sphere=True)[0]
        return cloud.rows(heavy[chosen.numpy()])


@dataclass(frozen=True)
class Classes:
    """The classes of the points of all clouds, and how many points each class keeps.

    Attributes:
        of_clouds: ``(N,)`` of every cloud.
        least: number of points that every class keeps where it has them; None: its share.
    """

    of_clouds: list[NDArray[np.int64]]
    least: int | None

    @classmethod
    def of(cls, stratify: Any, least: Any, clouds: Clouds) -> "Classes":
        """Check and split the arguments of ``downsample``.

        Raises:
            UserError: they are no classes of the points, or no number.
        """
        number = python_number(least)
        is_least = is_whole_number(number) and number >= 1
        if least is not None and not is_least:
            raise UserError(
                f"stratify_min must be a whole number of at least 1, got {least!r:.99}."
            )
        sizes = [len(cloud.points) for cloud in clouds.clouds]
        labels = _split_labels(stratify, sizes, clouds.form == "list")
        if [of_cloud.shape for of_cloud in labels] != [(size,) for size in sizes]:
            raise UserError(
                "stratify must hold the class of every point: (N,), (B, N) or (P,) whole numbers, "
                "or a list of (N,) for a list of clouds."
            )
        return cls(labels, number)

    def sample(self, number_of_cloud: int, cloud: Cloud, m: int, choice: Choice) -> Sample:
        """Downsample each class of one cloud on its own."""
        classes = self.of_clouds[number_of_cloud]
        shares = share_among_classes(count_classes(classes), m, self.least)
        kept = []
        for label, share in shares.items():
            if share == 0:
                continue
            members = np.flatnonzero(classes == label)
            _, rows = choice.sample(cloud.take(members), share)
            assert rows is not None  # check_stratified
            kept.append(members[rows.cpu().numpy()])
        return cloud.rows(np.sort(np.concatenate(kept)))


def _split_labels(stratify: Any, sizes: list[int], is_list: bool) -> list[NDArray[np.int64]]:
    """Return the labels of each cloud, of which the numbers may be wrong."""
    if not is_list:
        ends = np.cumsum(sizes)
        together = _whole_numbers(stratify).reshape(-1)
        return list(np.split(together, ends[:-1]))
    if not isinstance(stratify, list | tuple):
        return []
    return [_whole_numbers(labels) for labels in stratify]


def _whole_numbers(values: Any) -> NDArray[np.int64]:
    labels = as_tensor("stratify", values).detach().cpu()
    if labels.is_floating_point() or labels.is_complex():
        raise UserError(f"stratify must hold whole numbers, got {labels.dtype}.")
    numbers: NDArray[np.int64] = labels.to(torch.int64).numpy()
    return numbers


def check_stratified(choice: Choice) -> None:
    """Check that classes can be sampled one by one.

    Raises:
        UserError: an argument is for whole clouds.
    """
    if choice.readout != "completed":
        raise UserError(f"stratify keeps input points: no readout {choice.readout!r:.99}.")
    if isinstance(choice.start, int):
        raise UserError("stratify samples every class on its own: no start row, got a number.")


def to_number(
    points: Any,
    m: Any,
    batch: Any,
    weight: Any,
    choice: Choice,
    stratify: Any = None,
    stratify_min: Any = None,
) -> tuple[Any, Any]:
    """Downsample clouds to numbers of points; see ``downsample``."""
    clouds = Clouds.of(points, batch, weight)
    is_per_cloud = isinstance(m, list | tuple)
    sizes = _numbers(m, clouds)
    choice.check(weight)
    classes = None
    if stratify is not None:
        check_stratified(choice)
        classes = Classes.of(stratify, stratify_min, clouds)
    may_be_small = clouds.form in ("list", "flat")
    samples = []
    for number, (cloud, size) in enumerate(zip(clouds.clouds, sizes, strict=True)):
        available = len(cloud.points)
        is_small = available < size
        if is_small and not may_be_small:
            raise UserError(f"m must be at most the number of points N={available}, got m={size}.")
        if is_small:
            samples.append(cloud.rows(np.arange(available)))
        elif classes is None:
            samples.append(choice.sample(cloud, size))
        else:
            samples.append(classes.sample(number, cloud, size, choice))
    return clouds.join(samples, same_size=not is_per_cloud)


def _numbers(m: Any, clouds: Clouds) -> Sequence[int]:
    """Return how many points to keep of each cloud."""
    sizes = [m] * len(clouds.clouds)
    if isinstance(m, list | tuple):
        sizes = [as_size(size) for size in m]
    if len(sizes) != len(clouds.clouds):
        raise UserError(f"m: {len(sizes)} numbers for {len(clouds.clouds)} clouds.")
    numbers = []
    for size, cloud in zip(sizes, clouds.clouds, strict=True):
        numbers.append(number_of(size, len(cloud.points)))
    return numbers
