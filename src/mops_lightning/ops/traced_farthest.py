"""Farthest points as operations of an exported program, which has no compiled loops."""

import torch
from torch import Tensor
from torch._higher_order_ops import while_loop


def farthest_from_mean(points: Tensor, m: int) -> Tensor:
    """Return rows of farthest points; the first is the point farthest from the mean.

    The lowest row wins a tie.

    Args:
        points: ``(B, N, C)``.
        m: number of rows, at most N. With a larger m, a program ends with an error: it looks up
            row N, which does not exist.

    Returns:
        ``(B, m)`` int64 in the order of choice.
    """
    exact = points.detach().double()
    number = exact.shape[1]
    centre = exact.mean(1, keepdim=True)
    first = _squares(exact, centre).argmax(1)
    columns = torch.arange(m, device=points.device)
    rows = first[:, None].repeat(1, m)
    distances = torch.full_like(exact[..., 0], torch.inf)
    step = torch.ones((), dtype=torch.int64, device=points.device)

    def continues(step: Tensor, last: Tensor, rows: Tensor, distances: Tensor) -> Tensor:
        return step < m

    def choose(
        step: Tensor, last: Tensor, rows: Tensor, distances: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        channels = exact.shape[2]
        place = last[:, None, None].expand(-1, 1, channels)
        point = exact.gather(1, place)
        lowered = torch.minimum(distances, _squares(exact, point))
        lowered = lowered.scatter(1, last[:, None], -1.0)
        largest, row = lowered.max(1)
        chosen = torch.where(largest < 0, number, row)
        new_rows = torch.where(columns == step, chosen[:, None], rows)
        return step + 1, chosen, new_rows, lowered

    state = (step, first, rows, distances)
    chosen_rows: Tensor = while_loop(continues, choose, state)[2]
    return chosen_rows


def _squares(points: Tensor, centre: Tensor) -> Tensor:
    """Return the squared distances ``(B, N)`` of points ``(B, N, C)`` from one point each."""
    return (points - centre).square().sum(2)
