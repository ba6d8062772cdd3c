"""Blocked argmax and argmin, several times faster than torch's on a CPU."""

from torch import Tensor

GROUP = 32
"""Number of consecutive values that ``blocked_argextreme`` reduces together."""

PLAIN_MAX_VALUES = 8192
"""Up to this number of values, torch's own argmax and argmin are faster."""


def blocked_argextreme(values: Tensor, largest: bool) -> Tensor:
    """Return ``values.argmax(1, keepdim=True)`` or ``values.argmin(1, keepdim=True)``.

    On a CPU, torch vectorises ``amax`` but not ``argmax``. This function therefore reduces groups
    of values first and searches for positions only among the groups and in the winning group.

    Args:
        values: ``(rows, L)``, L a multiple of ``GROUP``.
        largest: True for the maximum, False for the minimum.

    Returns:
        ``(rows, 1)`` int64; the lowest position in case of ties.
    """
    if values.numel() <= PLAIN_MAX_VALUES:
        return values.argmax(1, keepdim=True) if largest else values.argmin(1, keepdim=True)
    groups = values.view(len(values), -1, GROUP)
    extremes = groups.amax(2) if largest else groups.amin(2)
    group = extremes.argmax(1, keepdim=True) if largest else extremes.argmin(1, keepdim=True)
    winners = groups.gather(1, group[..., None].expand(-1, 1, GROUP))
    offset = winners.argmax(2) if largest else winners.argmin(2)
    return offset.add_(group, alpha=GROUP)
