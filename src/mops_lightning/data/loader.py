"""A data loader from memory, without worker processes, whose order can be resumed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Generator, Tensor

from mops_lightning.channels import NO_CHANNELS, PointChannels, coordinates, with_coordinates
from mops_lightning.data.clouds import Clouds
from mops_lightning.errors import UserError, check_at_least
from mops_lightning.ops.points import gather_points
from mops_lightning.seeding import generator
from mops_lightning.types import Batch

JITTER_CLIP = 5
"""Largest noise of the augmentation in standard deviations, as PointNet was trained."""
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Augmentation:
    """Random changes of the coordinates of training clouds.

    Attributes:
        rotate_up: rotate every cloud by a random angle about the vertical axis: ``x``, ``y`` or
            ``z``; true means y.
        jitter: standard deviation of the noise added to every coordinate, which is clipped at five
            standard deviations.
        stretch: every axis of a cloud is scaled by a factor drawn between 1/stretch and stretch.
        shift: largest shift of a cloud along every axis.

    Raises:
        UserError: an argument is out of range.
    """

    rotate_up: bool | Literal["x", "y", "z"] = False
    jitter: float = 0.0
    stretch: float = 1.0
    shift: float = 0.0

    def __post_init__(self) -> None:
        """Check the arguments."""
        check_at_least(0, jitter=self.jitter, shift=self.shift)
        check_at_least(1, stretch=self.stretch)
        if self.rotate_up not in (True, False, *AXES):
            raise UserError(
                "rotate_up must be true, false, x, y or z (the vertical axis), got "
                f"{self.rotate_up!r}."
            )

    def __call__(
        self, points: Tensor, rng: Generator, channels: PointChannels = NO_CHANNELS
    ) -> Tensor:
        """Return the augmented ``(B, N, 3 + C)`` points; their normals turn with them.

        Other channels stay as they are. The random numbers do not depend on the channels.
        """
        if self.rotate_up:
            angle = torch.rand(len(points), generator=rng) * (2 * torch.pi)
            matrix = self._rotations(angle)
            points = channels.rotated(points, matrix)
        if self.jitter:
            most = JITTER_CLIP * self.jitter
            places = coordinates(points)
            noise = torch.randn(places.shape, generator=rng).mul_(self.jitter)
            noise = noise.clamp_(-most, most)
            points = with_coordinates(points, places + noise)
        if self.stretch > 1 or self.shift:
            scale, offset = torch.rand(2, len(points), 1, 3, generator=rng)
            least = 1 / self.stretch
            factors = least + (self.stretch - least) * scale
            points = channels.stretched(points, factors)
            shifts = self.shift * (2 * offset - 1)
            moved = coordinates(points) + shifts
            points = with_coordinates(points, moved)
        return points

    def _rotations(self, angle: Tensor) -> Tensor:
        """Return matrices ``(B, 3, 3)`` of rotations about the vertical axis."""
        cos = angle.cos()
        sin = angle.sin()
        zero = torch.zeros_like(angle)
        one = zero + 1
        rows = [cos, zero, sin, zero, one, zero, -sin, zero, cos]
        matrix = torch.stack(rows, 1).view(-1, 3, 3)
        # These matrices are for y; moved along the diagonal, they are for another axis.
        up = "y"
        if isinstance(self.rotate_up, str):
            up = self.rotate_up
        shift = AXES.index(up) - AXES.index("y")
        return matrix.roll((shift, shift), (1, 2))


FIXED = 11
DRAWN = 12
"""Random streams of tasks: the same in every epoch, or new in every epoch."""
DENSITY = 14
"""Random stream of the points that are drawn from clouds of different sizes."""
WINDOW = 8
"""Batches whose clouds are sorted by size together."""

MakeBatch = Callable[[Tensor, list[Generator]], Any]
"""Function that converts clouds for a task, given one random generator per cloud."""


@dataclass(eq=False, repr=False)
class CloudLoader:
    """Iterable over the batches of a split, as ``Batch`` or as converted by the task.

    The content of batch i depends on the seed, the epoch and i only, so that a resumed run gets the
    same batches as an uninterrupted one.

    Clouds of different sizes, with ``Clouds.sizes``: with ``shuffle``, a batch has clouds of
    similar sizes, and each of them has as many of its points, drawn anew in every epoch, as the
    smallest of the batch. Without ``shuffle``, each cloud is a batch of its own, with all points.

    Args:
        clouds: the split, in memory.
        batch_size: clouds per batch; 1 for clouds of different sizes without ``shuffle``.
        shuffle: whether every epoch has a new order; otherwise the order of the split.
        augment: augmentation, or None.
        make_batch: the task's conversion of clouds, see ``tasks.base.Task.make_batch``. Without
            ``shuffle`` its random numbers are the same in every epoch.
        drop_last: whether to drop an incomplete last batch, because BatchNorm cannot train on a
            single cloud; the only batch is never dropped.
        seed: seed of the order, the augmentation and ``make_batch``.
        channels: of the points.
        part: rank of this process and number of processes, which share every batch. With
            ``shuffle``, all shares have the same size; otherwise none is empty.
    """

    clouds: Clouds
    batch_size: int
    shuffle: bool = False
    augment: Augmentation | None = None
    make_batch: MakeBatch | None = None
    drop_last: bool = False
    seed: int = 0
    channels: PointChannels = NO_CHANNELS
    part: tuple[int, int] = (0, 1)

    def __post_init__(self) -> None:
        """Start before the first batch."""
        if self.clouds.sizes is not None and not self.shuffle:
            self.batch_size = 1
        full, rest = divmod(len(self.clouds.points), self.batch_size)
        self.batches = full
        leaves_out_rest = self.drop_last and full > 0
        if rest and not leaves_out_rest:
            self.batches += 1
        self.epoch = 0
        self.position = 0
        self.resume_at = 0

    def __len__(self) -> int:
        return self.batches

    @property
    def keeps_clouds(self) -> bool:
        """Whether the clouds are the same in every epoch, neither augmented nor converted."""
        is_fixed = self.clouds.sizes is None or not self.shuffle
        is_augmented = self.augment not in (None, Augmentation())
        return is_fixed and self.make_batch is None and not is_augmented

    def set_epoch(self, epoch: int) -> None:
        """Start ``epoch`` from its first batch, unless it is the current epoch."""
        if epoch != self.epoch:
            self.epoch = epoch
            self.position = 0
            self.resume_at = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the position of the next batch, which Lightning saves in checkpoints."""
        return {"epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a position saved by ``state_dict``."""
        self.epoch = state["epoch"]
        self.position = self.resume_at = state["position"]

    def __iter__(self) -> Iterator[Any]:
        # This code runs at the first batch, after set_epoch and load_state_dict.
        epoch = self.epoch
        number = len(self.clouds.points)
        start = self.resume_at
        self.resume_at = 0
        if self.shuffle:
            rng = generator(self.seed, epoch)
            order = torch.randperm(number, generator=rng)
            if self.clouds.sizes is not None:
                order = _similar_together(order, self.clouds.sizes, self.batch_size)
        else:
            order = torch.arange(number)
        batches = self._cut(order)[start:]
        for batch, (chosen, mine) in enumerate(batches, start):
            rng_of_density = generator(DENSITY, self.seed, epoch, batch)
            points, parts = self._points(chosen, rng_of_density)
            if self.augment is not None:  # the full batch, which shares one generator
                rng = generator(self.seed, epoch, batch)
                points = self.augment(points, rng, self.channels)
            self._advance(epoch, batch)
            if parts is not None:
                parts = parts[mine]
            yield self._made(points[mine], parts, chosen[mine], epoch)

    def _advance(self, epoch: int, batch: int) -> None:
        """Note that a batch was made: the next one may begin a new epoch."""
        is_last = batch + 1 == self.batches
        if is_last:
            self.epoch = epoch + 1
            self.position = 0
        else:
            self.epoch = epoch
            self.position = batch + 1

    def _points(self, rows: Tensor, rng: Generator) -> tuple[Tensor, Tensor | None]:
        """Return the points of clouds, as many as the smallest of them has, and their parts."""
        clouds = self.clouds.take(rows)
        points = clouds.points
        parts = clouds.parts
        if clouds.sizes is None:
            return points, parts
        number = clouds.smallest[1]
        # The smallest of random numbers, which are infinite for rows that repeat a cloud.
        drawn = torch.rand(points.shape[:2], generator=rng)
        place = torch.arange(points.shape[1])
        is_repeat = place >= clouds.sizes[:, None]
        drawn[is_repeat] = torch.inf
        smallest = drawn.topk(number, largest=False).indices
        kept = smallest.sort(1).values
        points = gather_points(points, kept)
        if parts is not None:
            parts = parts.gather(1, kept)
        return points, parts

    def _cut(self, order: Tensor) -> list[tuple[Tensor, slice]]:
        """Return the rows of every batch, and the slice of them that belongs to this process."""
        rank, processes = self.part
        if processes > 1 and not self.shuffle:
            # Shares differ by at most one cloud; all processes have the same number of batches.
            own = order.tensor_split(processes)[rank]
            everything = slice(None)
            return [(rows, everything) for rows in own.tensor_split(self.batches)]
        size = self.batch_size
        cut = []
        for batch in range(self.batches):
            rows = order[batch * size : (batch + 1) * size]
            share = len(rows) // processes
            cut.append((rows, slice(rank * share, (rank + 1) * share)))
        return cut

    def batch_of(self, rows: Tensor) -> Any:
        """Return the clouds with the rows ``(B,)`` as a batch; for loaders without shuffle."""
        rng = generator(DENSITY, self.seed)
        points, parts = self._points(rows, rng)
        return self._made(points, parts, rows, 0)

    def _made(self, points: Tensor, parts: Tensor | None, rows: Tensor, epoch: int) -> Any:
        if self.make_batch is None:
            return Batch(points, self.clouds.labels[rows], rows, parts)
        stream: tuple[int, ...] = (FIXED, self.seed)
        if self.shuffle:
            stream = (DRAWN, self.seed, epoch)
        generators = [generator(*stream, row) for row in rows.tolist()]
        return self.make_batch(points, generators)


def _similar_together(order: Tensor, sizes: Tensor, batch_size: int) -> Tensor:
    """Return a random order in which the clouds of a batch have similar sizes.

    Clouds of ``WINDOW`` batches at a time are sorted by size.
    """
    windows = []
    for rows in order.split(WINDOW * batch_size):
        by_size = sizes[rows].argsort(stable=True)
        windows.append(rows[by_size])
    return torch.cat(windows)
