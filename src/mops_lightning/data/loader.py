"""Batches straight from memory: no worker processes, and an order that can be resumed."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from mops_lightning.data.clouds import Clouds
from mops_lightning.errors import UserError
from mops_lightning.seeding import generator
from mops_lightning.types import Batch


@dataclass(frozen=True)
class Augmentation:
    """What training does to clouds before the nets see them.

    Attributes:
        rotate_up: turn every cloud by a random angle about the up axis (y).
        jitter: standard deviation of the noise added to every coordinate.
        jitter_clip: largest noise in either direction.
    """

    rotate_up: bool = False
    jitter: float = 0.0
    jitter_clip: float = 0.05

    def __post_init__(self) -> None:
        """Refuse negative sizes."""
        if self.jitter < 0 or self.jitter_clip < 0:
            raise UserError(
                "augment: jitter and jitter_clip must not be negative, "
                f"got {self.jitter} and {self.jitter_clip}."
            )

    def __call__(self, points: Tensor, rng: Generator) -> Tensor:
        """Return ``(B, N, 3)`` points, changed as the attributes say."""
        if self.rotate_up:
            angle = torch.rand(len(points), generator=rng) * (2 * torch.pi)
            cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
            rows = [cos, zero, sin, zero, zero + 1, zero, -sin, zero, cos]
            points = points @ torch.stack(rows, 1).view(-1, 3, 3)
        if self.jitter:
            noise = torch.randn(points.shape, generator=rng).mul_(self.jitter)
            points = points + noise.clamp_(-self.jitter_clip, self.jitter_clip)
        return points


FIXED, DRAWN = 11, 12
"""Streams of random numbers for what tasks draw: the same in every epoch, or new ones."""

MakeBatch = Callable[[Batch, Callable[[], list[Generator]]], Any]
"""What a task makes of a batch, given one source of random numbers for each cloud."""


class CloudLoader:
    """An iterable over one split, of ``Batch`` or of what the task makes of it.

    What batch i of an epoch holds depends on the seed, the epoch and i only, so a resumed run sees
    what an unbroken one would have seen.

    Args:
        clouds: the split, in memory.
        batch_size: clouds per batch.
        shuffle: new order every epoch; otherwise the order of the split.
        augment: None leaves the points alone.
        make_batch: what the task makes of a batch; see ``tasks.base.Task.make_batch``. Without
            ``shuffle`` it draws the same in every epoch.
        part: which share of every batch this process takes, and how many processes there are. In
            training (``shuffle``) all shares are equal, in tests none is empty.
        drop_last: leave out a last batch that is not full (BatchNorm cannot train on one cloud);
            never when there is no full one.
        seed: of order, augmentation and what ``make_batch`` draws.
    """

    def __init__(
        self,
        clouds: Clouds,
        batch_size: int,
        shuffle: bool = False,
        augment: Augmentation | None = None,
        make_batch: MakeBatch | None = None,
        drop_last: bool = False,
        seed: int = 0,
        part: tuple[int, int] = (0, 1),
    ) -> None:
        self.clouds = clouds
        self.batch_size = batch_size
        self.shuffle = shuffle
        self.augment = augment
        self.make_batch = make_batch
        self.seed = seed
        self.part = part
        number = len(clouds.points)
        full = number // batch_size
        self.batches = full if drop_last and full else -(-number // batch_size)
        self.epoch = 0
        self.position = 0
        self.resume_at = 0

    def __len__(self) -> int:
        return self.batches

    def set_epoch(self, epoch: int) -> None:
        """Start ``epoch`` from its first batch, unless it is the one under way."""
        if epoch != self.epoch:
            self.epoch, self.position, self.resume_at = epoch, 0, 0

    def state_dict(self) -> dict[str, Any]:
        """Where the next batch lies; Lightning keeps this in its checkpoints."""
        return {"epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from ``state``."""
        self.epoch = state["epoch"]
        self.position = self.resume_at = state["position"]

    def __iter__(self) -> Iterator[Any]:
        # The body runs at the first batch, after set_epoch and load_state_dict have been called.
        epoch, number = self.epoch, len(self.clouds.points)
        start, self.resume_at = self.resume_at, 0
        if self.shuffle:
            order = torch.randperm(number, generator=generator(self.seed, epoch))
        else:
            order = torch.arange(number)
        for batch, (chosen, mine) in enumerate(self._cut(order)[start:], start):
            points = self.clouds.points[chosen]
            if self.augment is not None:  # all clouds of the batch: they draw from one source
                points = self.augment(points, generator(self.seed, epoch, batch))
            last = batch + 1 == self.batches
            self.epoch, self.position = (epoch + 1, 0) if last else (epoch, batch + 1)
            yield self._made(points[mine], chosen[mine], epoch)

    def _cut(self, order: Tensor) -> list[tuple[Tensor, slice]]:
        """Return the rows of every batch, and which of them are this process's."""
        rank, processes = self.part
        if processes > 1 and not self.shuffle:
            # Shares may differ by a cloud, but everyone has as many batches and none is empty.
            own = order.tensor_split(processes)[rank]
            return [(rows, slice(None)) for rows in own.tensor_split(self.batches)]
        size = self.batch_size
        cut = [order[batch * size : (batch + 1) * size] for batch in range(self.batches)]
        shares = [len(rows) // processes for rows in cut]
        return [
            (rows, slice(rank * share, (rank + 1) * share))
            for rows, share in zip(cut, shares, strict=True)
        ]

    def batch_of(self, rows: Tensor) -> Any:
        """Return the given clouds ``(B,)`` as one batch, for a loader that does not shuffle."""
        return self._made(self.clouds.points[rows], rows, 0)

    def _made(self, points: Tensor, rows: Tensor, epoch: int) -> Any:
        batch = Batch(points, self.clouds.labels[rows])
        if self.make_batch is None:
            return batch
        stream = (DRAWN, self.seed, epoch) if self.shuffle else (FIXED, self.seed)
        return self.make_batch(batch, lambda: [generator(*stream, row) for row in rows.tolist()])
