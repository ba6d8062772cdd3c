"""Base class of all samplers, and sampling in chunks."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from numbers import Integral
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.ops.attention import Partial
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.precision import restrict_autocast_to_pointwise
from mops_lightning.ops.readout import READOUTS, select
from mops_lightning.samplers.carried import with_carried
from mops_lightning.samplers.checks import check_dtype, check_points
from mops_lightning.samplers.fused import PART, FusedMOPSNet
from mops_lightning.samplers.ragged import Method, Select, select_in_unit_sphere, select_points
from mops_lightning.types import SampleOutput

Chunks = Callable[[], Iterable[Tensor]]
"""Function that iterates over the chunks ``(n, 3 + C)`` of a cloud, always in the same order."""

WEIGHTED = "Use fps, random, poisson, or the completed readout of a trained sampler."
"""Advice where weights are not possible."""


class Sampler(nn.Module):
    """Base class of all samplers: checks the input, then calls ``sample``.

    Maps ``(B, N, 3)`` points to a ``SampleOutput`` with ``(B, M, 3)`` points. A subclass implements
    ``sample(points, m)``. A learned sampler also implements ``losses``, a flexible one
    ``training_sizes``, and a sampler with a training schedule ``anneal``.

    Points may have C channels beside their coordinates: ``(B, N, 3 + C)``. ``sample`` sees
    coordinates, unless a subclass sets ``self.point_channels``: then it sees points with these
    channels. A sampler without learned weights takes points with any channels. Sampled points have
    all channels of their input: where ``sample`` returns coordinates only, each point has the
    channels of its input point or, if it is generated, of the nearest one.

    Args:
        m: number of points to return; for a flexible sampler, the largest number.

    Raises:
        UserError: ``m`` is not a whole number of at least 1.

    Examples:
        >>> import torch
        >>> from mops_lightning import SampleOutput, Sampler
        >>> class FirstPoints(Sampler):
        ...     def sample(self, points, m):
        ...         rows = torch.arange(m).expand(len(points), m)
        ...         return SampleOutput(points[:, :m], rows, {})
        >>> FirstPoints(m=8)(torch.rand(2, 64, 3)).points.shape
        torch.Size([2, 8, 3])
    """

    flexible: bool = False
    """Whether one instance returns any 1 ≤ m ≤ ``self.m`` points; otherwise m is ``self.m``."""

    generates: bool = False
    """Whether the points are generated, so that matched and completed sets differ from them;
    otherwise they are input points, returned with their indices."""

    projects: bool = False
    """Whether generated points have a soft projection onto the cloud (``project``), a readout."""

    nested: bool = False
    """Whether the sample of a smaller size is the first part of the sample of a larger one."""

    any_unit: bool = False
    """Whether ``choose_rows`` takes clouds in any unit, so that ``downsample`` and the command line
    need not move them into the unit sphere first."""

    streams: bool = False
    """Whether clouds can be sampled in chunks (``stream_sample``), by ``fused``."""

    is_thinned: bool = False
    """Whether generated points come from few candidates of a cloud, so that beside the points
    themselves little memory is needed."""

    spreads: bool = True
    """Whether the method spreads the points evenly; random and serial sampling do not."""

    predicts_residuals: bool = False
    """Whether the method learns residuals of points in registration, and nothing else."""

    size_reduction: Literal["mean", "sum"] = "mean"
    """Reduction of the losses at several ``training_sizes`` to one."""

    def __init__(self, m: int) -> None:
        super().__init__()
        is_whole = isinstance(m, int) and not isinstance(m, bool)
        if not is_whole or m < 1:
            raise UserError(f"m must be a whole number of at least 1, got {m!r}.")
        self.m = m
        self.point_channels = PointChannels.of(0)

    def forward(self, points: Tensor, m: int | None = None) -> SampleOutput:
        """Sample every cloud of a batch.

        Args:
            points: ``(B, N, 3 + C)`` floating point, finite, N ≥ m; channels as in training.
            m: number of points to return; None means ``self.m``.

        Returns:
            ``SampleOutput`` with ``(B, m, 3 + C)`` points, on the device and in the dtype of the
            input.

        Raises:
            UserError: ``points`` or ``m`` is invalid.
        """
        if m is None:
            m = self.m
        return self.sample_sizes(points, (m,))[m]

    @torch.no_grad()
    def downsample(
        self,
        points: Any,
        m: int | None = None,
        readout: str = "completed",
        batch: Any = None,
        weight: Any = None,
    ) -> tuple[Any, Any]:
        """Sample clouds in their own unit: normalised as in training, sampled, mapped back.

        Samplers with ``any_unit`` choose among the given coordinates instead.

        Args:
            points: ``(N, 3)``, ``(B, N, 3)``, or ``(P, 3)`` with ``batch``; a tensor or an array.
                Channels follow x, y and z, in the units of files.
            m: number of points to return of each cloud; None means ``self.m``.
            readout: of generated points: ``generated``, ``matched`` (the nearest input points,
                perhaps repeated) or ``completed`` (m different input points).
            batch: ``(P,)`` the cloud of every point, ascending from 0, where clouds of several
                sizes are one after the other.
            weight: ``(N,)``, ``(B, N)`` or ``(P,)`` numbers of at least 0, or ``"curvature"`` to
                compute them. Points with a larger weight are preferred; points of weight 0 are left
                out. For samplers with ``sample_weighted``, and for completed sets, which are then
                filled up by weight.

        Returns:
            The points with their channels, and their indices in the input, or None for generated
            points; tensors or arrays like the input. For ``(N, 3)`` points ``(m, 3)`` and
            ``(m,)``, for ``(B, N, 3)`` ``(B, m, 3)`` and ``(B, m)``, with ``batch`` both of all
            clouds one after the other; a cloud with fewer than m points is then returned whole.

        Raises:
            UserError: an argument is invalid, or the sampler is in training mode.

        Example:
            >>> import torch
            >>> from mops_lightning import FPSSampler
            >>> points, indices = FPSSampler(m=8).downsample(100 * torch.rand(64, 3))
            >>> points.shape, indices.shape
            (torch.Size([8, 3]), torch.Size([8]))
        """
        if m is None:
            m = self.m
        self.check_m(m)
        if readout not in READOUTS:
            hint = did_you_mean(str(readout), READOUTS)
            raise UserError(f"readout: unknown {readout!r}.{hint}")
        if self.learned and self.training:
            raise UserError("downsample needs a sampler in eval mode: call eval() first.")
        if weight is not None:
            self.check_weighted(readout)

        select: Select = partial(self.select, readout)
        if not self.any_unit:
            select = partial(select_in_unit_sphere, select, self.point_channels)
        any_channels = self.channels_of_input is None
        method = Method(select, self.point_channels, any_channels)
        return select_points(method, points, m, batch, weight)

    @torch.no_grad()
    def select(
        self,
        readout: str,
        clouds: Tensor,
        m: int,
        weight: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Sample clouds ``(B, N, 3)``; see ``downsample``.

        Unless the sampler has ``any_unit``, the clouds are in the unit sphere. Weights ``(B, N)``
        are above 0. Returns the points ``(B, m, 3)``, and their rows or None.
        """
        if self.any_unit:
            self.check_m(m)
            check_points(clouds, at_least=m, channels=self.channels_of_input)
            rows = self.choose_rows(coordinates(clouds), m, weight)
            return gather_points(clouds, rows), rows
        if weight is not None and not self.generates:
            check_points(clouds, at_least=m, channels=self.channels_of_input)
            rows = self.sample_weighted(coordinates(clouds), m, weight)
            return gather_points(clouds, rows), rows
        given = clouds.to(next(self.parameters(), clouds))  # dtype and device
        if self.streams and given.shape[1] > PART:  # features of all points take more memory
            generated = torch.stack([self._streamed(cloud, m) for cloud in given])
        else:
            generated, indices, *_ = self(given, m)
            if not self.generates:
                return generated, indices
        return select(clouds, generated.to(clouds.device), readout, weight)

    def _streamed(self, cloud: Tensor, m: int) -> Tensor:
        chunks = partial(iter, [cloud])
        return stream_sample(self, chunks, m)

    def seen_of(self, points: Tensor) -> Tensor:
        """Return the columns of ``(B, N, 3 + C)`` points that ``sample`` sees."""
        if self.point_channels:
            return points
        return coordinates(points)

    def _checked(self, points: Tensor, m: int) -> SampleOutput:
        """Check the points and sample them, without losses."""
        # A graph cannot branch on values, and on a GPU the check waits for the device.
        waits_for_device = self.training and points.is_cuda
        finite = not (torch.compiler.is_compiling() or waits_for_device)
        check_points(points, at_least=m, finite=finite, channels=self.channels_of_input)
        dtype = next((weights.dtype for weights in self.parameters()), points.dtype)
        if not torch.is_autocast_enabled(points.device.type):
            check_dtype(points, dtype)
        seen = self.seen_of(points)
        with restrict_autocast_to_pointwise(points.device.type):
            sampled = self.sample(seen.to(dtype), m)
            output = with_carried(sampled, points)
        return output._replace(points=output.points.to(points.dtype))

    def sample_sizes(self, points: Tensor, sizes: Sequence[int]) -> dict[int, SampleOutput]:
        """Sample at several sizes; a nested sampler runs once, at the largest.

        Args:
            points: as for ``forward``.
            sizes: each as ``m`` for ``forward``.

        Returns:
            The result of ``forward`` by size.

        Raises:
            UserError: ``points`` or a size is invalid.
        """
        if not self.nested and len(sizes) > 1:
            return {m: self(points, m) for m in sizes}
        for m in sizes:
            self.check_m(m)
        largest = self._checked(points, max(sizes))
        losses: dict[int, dict[str, Tensor]] = {}
        if self.training:
            losses = self.losses(points, largest, sizes)
        outputs = {}
        for m in sizes:
            output = largest.first(m)
            outputs[m] = output._replace(losses=losses.get(m, {}))
        return outputs

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Sample checked input; arguments and result as in ``forward``."""
        raise NotImplementedError

    def sample_weighted(self, points: Tensor, m: int, weight: Tensor) -> Tensor:
        """Return rows ``(B, m)`` of checked input, chosen by positive weights ``(B, N)``."""
        raise NotImplementedError  # see check_weighted

    def choose_rows(self, points: Tensor, m: int, weight: Tensor | None = None) -> Tensor:
        """Return rows ``(B, m)`` of checked clouds ``(B, N, 3)`` in any unit; see ``any_unit``.

        The rows are those of the clouds in the unit sphere, unless distances tie up to the rounding
        of these to float32: ties are those of the given coordinates.
        """
        raise NotImplementedError

    def check_weighted(self, readout: str) -> None:
        """Check that the sampler takes weights.

        Raises:
            UserError: neither the method nor the readout of generated points has weights.
        """
        if self.generates and readout != "completed":
            raise UserError(f"weight: the {readout} readout takes no weights. {WEIGHTED}")
        takes_weights = type(self).sample_weighted is not Sampler.sample_weighted
        if not self.generates and not takes_weights:
            name = type(self).__name__
            raise UserError(f"weight: {name} takes no weights. {WEIGHTED}")

    def losses(
        self, points: Tensor, output: SampleOutput, sizes: Sequence[int]
    ) -> dict[int, dict[str, Tensor]]:
        """Return the weighted loss terms of the first points of a training output.

        Args:
            points: ``(B, N, 3)`` the input.
            output: the sample of the largest size.
            sizes: sizes to compute the losses for.

        Returns:
            Scalar terms by size and name; empty for a sampler without losses.
        """
        return {}

    def project(self, generated: Tensor, points: Tensor) -> Tensor:
        """Return the soft projection ``(B, M, 3)`` of generated points ``(B, M, 3)``.

        Args:
            generated: the points that the sampler generated for ``points``.
            points: ``(B, N, 3)`` the clouds.
        """
        raise NotImplementedError  # see projects

    def training_sizes(self) -> tuple[int, ...]:
        """Return the sizes of the next training step; random ones use torch's global generator."""
        return (self.m,)

    def anneal(self, progress: float) -> None:
        """Update schedules for the training progress, from 0 to 1; does nothing by default."""

    def fused(self) -> FusedMOPSNet:
        """Return the network that samples clouds in chunks, with copies of the weights.

        Raises:
            UserError: the sampler needs all points of a cloud at once.
        """
        raise UserError(
            f"{type(self).__name__} needs all points of a cloud at once and cannot sample in "
            "chunks. MOPS-Net and FMOPS-Net without anchors=fps can."
        )

    @property
    def channels_of_input(self) -> int | None:
        """How many channels points must have; None: any number."""
        if self.learned or self.point_channels:
            return len(self.point_channels)
        return None

    @property
    def learned(self) -> bool:
        """Whether the sampler has parameters to train."""
        return any(True for _ in self.parameters())

    def check_m(self, m: int) -> None:
        """Check that the sampler returns samples of size m.

        Raises:
            UserError: it does not return m points.
        """
        size: object = m  # mypy would take the check for needless
        if isinstance(size, bool) or not isinstance(size, Integral):
            raise UserError(f"m must be a whole number, got {m!r}.")
        if self.flexible and not 1 <= m <= self.m:
            raise UserError(f"m must be between 1 and {self.m}, got {m}.")
        if not self.flexible and m != self.m:
            name = type(self).__name__
            raise UserError(f"m must be {self.m}, the size this {name} was made for, got {m}.")


def stream_sample(sampler: Sampler, chunks: Chunks, m: int | None = None) -> Tensor:
    """Sample a cloud that is read in chunks.

    MOPS-Net reduces the points of a cloud twice: to a maximum (the global feature) and to a
    softmax-weighted sum (paper section "Efficient Regression of the Sampled Set"). Both reductions
    are associative: chunks may be merged in any order, also by several machines, and memory does
    not grow with N.

    Args:
        sampler: a trained sampler; it is used in evaluation mode.
        chunks: the cloud, which is read twice; the largest chunk bounds the memory.
        m: number of points; None means ``sampler.m``.

    Returns:
        ``(m, 3 + C)``, equal to ``sampler(points, m).points`` up to the rounding of sums.

    Raises:
        UserError: the sampler needs whole clouds, ``m`` is out of range, or a chunk is invalid.
    """
    if m is None:
        m = sampler.m
    net = sampler.fused()
    sampler.check_m(m)
    checked = _checked_chunks(chunks, m, sampler)
    peaks = (net.global_part(chunk) for chunk in checked)
    global_ = reduce(torch.maximum, peaks)
    sums = (net.sum_part(chunk, global_, m) for chunk in chunks())
    total = reduce(Partial.merge, sums)
    return sampler.point_channels.renormalised(total.result())


def _checked_chunks(chunks: Chunks, m: int, sampler: Sampler) -> Iterable[Tensor]:
    number = 0
    for chunk in chunks():
        check_points(chunk[None], channels=sampler.channels_of_input)
        check_dtype(chunk, next(sampler.parameters()).dtype)
        number += len(chunk)
        yield chunk
    if number < m:
        raise UserError(f"m must be at most the number of points N={number}, got m={m}.")
