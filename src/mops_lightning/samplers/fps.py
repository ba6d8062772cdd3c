"""Farthest point sampling (FPS), a baseline in the paper's tables."""

import torch
from torch import Tensor

from mops_lightning.errors import UserError
from mops_lightning.ops import compiled
from mops_lightning.ops.farthest import FARTHEST
from mops_lightning.ops.fps import farthest
from mops_lightning.ops.keys import SeededOrder
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.ordering import exact_mean, seeded_hashes
from mops_lightning.types import SampleOutput


class FPSSampler(Sampler):
    """Choose input points, each as far as possible from the points chosen before it.

    Eldar et al., "The Farthest Point Strategy for Progressive Image Sampling", IEEE TIP 1997.

    Flexible and nested. The seeded order of the cloud (see ``ordering``) determines the first point
    and breaks ties, so that the sample depends on the seed and the cloud only: neither on the rest
    of the batch nor, unless ``start`` is an index, on the order of the points. Among copies of a
    point the lowest index comes first.

    Args:
        m: largest number of points to return.
        seed: determines the first point.
        start: the first point in every cloud: an index, or ``"farthest"`` for the point farthest
            from the mean, which turns and moves with the cloud; None means that the seed determines
            it. With ``"farthest"``, both clouds of a registration pair start from the same point.

    Raises:
        UserError: ``start`` is negative, another word or, when sampling, at least N.

    Examples:
        >>> import torch
        >>> from mops_lightning import FPSSampler
        >>> line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]]])  # (B, N, 3)
        >>> FPSSampler(m=3, start=0)(line).indices  # (B, m)
        tensor([[0, 3, 2]])
    """

    flexible = True
    nested = True
    any_unit = True

    def __init__(self, m: int, seed: int = 0, start: int | str | None = None) -> None:
        super().__init__(m)
        is_row = isinstance(start, int) and not isinstance(start, bool) and start >= 0
        is_word = isinstance(start, str) and start == FARTHEST
        if not (is_row or is_word or start is None):
            raise UserError(
                f"start must be at least 0, {FARTHEST}, or null (None) to let the seed choose, "
                f"got {start!r:.99}."
            )
        self.seed = seed
        self.start = start

    def sample(self, points: Tensor, m: int) -> SampleOutput:
        """Return m of the points ``(B, N, 3)`` with their indices, in the order of choice."""
        indices = farthest_rows(points, m, self.seed, self.start)
        return SampleOutput(gather_points(points, indices), indices, {})

    def sample_weighted(self, points: Tensor, m: int, weight: Tensor) -> Tensor:
        """Multiply distances by weights; the first point is the heaviest, unless ``start`` is set.

        See ``ops.fps.farthest_point_sample``.
        """
        return farthest_rows(points, m, self.seed, self.start, weight)

    def choose_rows(self, points: Tensor, m: int, weight: Tensor | None = None) -> Tensor:
        """Choose as ``sample`` and ``sample_weighted`` do, in any unit."""
        return farthest_rows(points, m, self.seed, self.start, weight, in_sphere=True)


def farthest_rows(
    points: Tensor,
    m: int,
    seed: int = 0,
    start: int | str | None = None,
    weight: Tensor | None = None,
    in_sphere: bool = False,
) -> Tensor:
    """Return rows ``(B, m)`` of farthest points in the order of choice.

    Args:
        points: ``(B, N, C)``.
        m: number of points.
        seed: of the order that breaks ties and, without ``start``, determines the first point.
        start: the first point, as for ``FPSSampler``.
        weight: ``(B, N)`` as for ``farthest_point_sample``.
        in_sphere: take the order of the clouds in the unit sphere; see ``ops.keys.SeededOrder``.

    Raises:
        UserError: ``start`` is at least N.
    """
    n = points.shape[1]
    if isinstance(start, int) and start >= n:
        raise UserError(f"start must be less than the number of points N={n}, got {start}.")
    order = SeededOrder(seed, in_sphere)
    rows = compiled.farthest_from_start(points, m, order, start, weight)
    if rows is not None:
        return rows
    keys = seeded_hashes(points, seed, in_sphere)
    if isinstance(start, int):
        first = torch.full((len(points),), start, device=points.device)
    elif start == FARTHEST:
        squares = _squares_from_mean(points.detach())
        first = _first_of_largest(squares, keys)
    elif weight is not None:
        first = _first_of_largest(weight, keys)
    else:
        first = keys.argmin(1)
    one = torch.ones_like(first)
    return farthest(points.detach(), first[:, None], one, m, weight, keys)


def _squares_from_mean(points: Tensor) -> Tensor:
    """Return the float64 squared distances ``(B, N)`` of points ``(B, N, C)`` from their mean."""
    exact = points.double()
    centre = exact_mean(exact)
    squares = torch.zeros_like(exact[..., 0])
    for axis in range(points.shape[2]):
        apart = exact[..., axis] - centre[..., axis]
        squares += apart.square()
    return squares


def _first_of_largest(values: Tensor, keys: Tensor) -> Tensor:
    """Return the rows ``(B,)`` of the largest values; the lowest key, then row wins a tie."""
    is_largest = values == values.amax(1, keepdim=True)
    last = torch.iinfo(keys.dtype).max
    return torch.where(is_largest, keys, last).argmin(1)
