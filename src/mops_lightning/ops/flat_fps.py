"""Farthest points of flat clouds, with the arguments of ``torch_geometric.nn.fps``.

Arrays are sampled without importing torch.
"""

from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from mops_lightning.errors import UserError
from mops_lightning.ops.batches import cloud_sizes
from mops_lightning.ops.farthest import Array, Rows, farthest_rows, float_points

if TYPE_CHECKING:
    from torch import Tensor


@overload
def fps(
    x: "Tensor",
    batch: "Tensor | None" = None,
    ratio: Any = 0.5,
    random_start: bool = True,
    batch_size: int | None = None,
) -> "Tensor": ...
@overload
def fps(
    x: NDArray[Any],
    batch: NDArray[Any] | None = None,
    ratio: Any = 0.5,
    random_start: bool = True,
    batch_size: int | None = None,
) -> NDArray[np.int64]: ...
def fps(
    x: Any,
    batch: Any = None,
    ratio: Any = 0.5,
    random_start: bool = True,
    batch_size: int | None = None,
) -> Any:
    """Choose farthest points of flat clouds: a replacement for ``torch_geometric.nn.fps``.

    The arguments are those of PyTorch Geometric, and so is the number of chosen points: that of
    pyg-lib, which PyTorch Geometric 2.8 calls. Every choice is that of float64 arithmetic on the
    given numbers, the lowest row in case of ties:

    - Float64 points: the rows of pyg-lib and torch_cluster. They number ⌈ratio · n⌉ in float32 in
      pyg-lib and here, in the points' type in torch_cluster.
    - Float32 or half points: pyg-lib and torch_cluster compute distances in the points' type, and
      choose the same rows unless two distances are equal up to their rounding. That is rare in
      measured coordinates and frequent in rounded ones.
    - Where a cloud has fewer different points than are chosen, copies are chosen here, and the same
      row again in pyg-lib and torch_cluster.
    - Open3D computes in float64 and chooses the same rows for the same first point, until only
      copies are left. ``fpsample.fps_sampling`` computes in float32 and takes the last of tied
      rows.

    Args:
        x: ``(P, C)`` points of all clouds, or ``(P,)`` numbers, of any real type; a tensor or an
            array.
        batch: ``(P,)`` the cloud of every point, ascending from 0; None: one cloud.
        ratio: share of the points to choose, 0 < ratio ≤ 1: ⌈ratio · n⌉ of a cloud's n points; a
            tensor or an array holds one for all clouds, or one for each.
        random_start: start from a random point of every cloud instead of its first point.
            ``torch.manual_seed`` repeats it, and ``numpy.random.seed`` for arrays.
        batch_size: number of clouds; None: as many as ``batch`` has.

    Returns:
        Rows of ``x``, int64, cloud by cloud, in the order of choice; a tensor or an array like
        ``x``. With ``(B, N, C)`` points as ``x.flatten(0, 1)`` and ⌈ratio · N⌉ = M they are
        ``(B, M)``, flattened.

    Raises:
        UserError: an argument has a wrong shape or value.

    Examples:
        >>> import numpy as np
        >>> from mops_lightning import fps
        >>> square = np.array([[-1.0, -1], [-1, 1], [1, -1], [1, 1]])
        >>> fps(square, np.array([0, 0, 0, 0]), ratio=0.5, random_start=False)
        array([0, 3])
    """
    is_array = isinstance(x, np.ndarray)
    _check_points(x)
    if batch is None:
        counts = np.array([len(x)])
    else:
        counts = cloud_sizes(len(x), _on_cpu(batch))
    if batch_size is not None and batch_size < len(counts):
        raise UserError(f"batch_size must be at least {len(counts)}, got {batch_size}.")
    sizes = _sizes(counts, ratio)
    starts = np.zeros_like(counts)
    if random_start:
        starts = _random_starts(counts, is_array)
    if not is_array and x.device.type != "cpu":
        return _on_device(x, counts, sizes, starts)
    points = float_points(_on_cpu(x)).reshape(len(x), -1)
    rows = _chosen(points, counts, sizes, starts)
    if is_array:
        return rows
    import torch

    return torch.from_numpy(rows)


def _check_points(x: Any) -> None:
    is_numbers = isinstance(x, np.ndarray) or hasattr(x, "detach")
    if not is_numbers or x.ndim == 0 or len(x) == 0:
        shape = tuple(getattr(x, "shape", ()))
        raise UserError(
            f"x must be a tensor or an array (P, C) with P ≥ 1, got {type(x).__name__} {shape}."
        )


def _on_cpu(values: Any) -> Array:
    """Return a tensor's numbers as an array."""
    if isinstance(values, np.ndarray):
        return values
    values = values.detach().cpu()
    if str(values.dtype) == "torch.bfloat16":  # NumPy has no such type
        values = values.float()
    numbers: Array = values.numpy()
    return numbers


def _sizes(counts: Rows, ratio: Any) -> Rows:
    """Return ⌈ratio · n⌉ of every cloud, rounded as in pyg-lib, in float32."""
    if hasattr(ratio, "detach"):
        ratio = _on_cpu(ratio)
    shares = np.asarray(ratio, np.float32).reshape(-1)
    are_shares = ((shares > 0) & (shares <= 1)).all()
    if not are_shares or len(shares) not in (1, len(counts)):
        raise UserError(f"ratio must be above 0 and at most 1, one or one per cloud, got {ratio}.")
    exact = counts.astype(np.float32) * shares
    return np.ceil(exact).astype(np.int64)


def _are_alike(counts: Rows, sizes: Rows) -> bool:
    """Return whether all clouds have one number of points, of which one number is chosen."""
    have_same_counts = (counts == counts[0]).all()
    have_same_sizes = (sizes == sizes[0]).all()
    return bool(have_same_counts and have_same_sizes)


def _random_starts(counts: Rows, is_array: bool) -> Rows:
    """Draw the first point of every cloud."""
    if is_array:
        numbers = np.random.randint(2**62, size=len(counts))  # noqa: NPY002  as users seed it
    else:
        import torch

        numbers = torch.randint(2**62, (len(counts),)).numpy()
    return numbers % np.maximum(counts, 1)


def _chosen(points: Array, counts: Rows, sizes: Rows, starts: Rows) -> Rows:
    """Return the rows of all clouds, cloud by cloud."""
    begins = counts.cumsum() - counts
    if _are_alike(counts, sizes):
        clouds = points.reshape(len(counts), counts[0], -1)
        rows = _of_clouds(clouds, int(sizes[0]), starts)
        return (rows + begins[:, None]).reshape(-1)
    rows_of_clouds = []
    numbers = zip(begins, counts, sizes, starts, strict=True)
    for begin, count, m, start in numbers:
        if count == 0:
            continue
        cloud = points[begin : begin + count]
        rows = _of_clouds(cloud[None], m, start[None])[0]
        rows_of_clouds.append(rows + begin)
    return np.concatenate(rows_of_clouds)


def _of_clouds(clouds: Array, m: int, starts: Rows) -> Rows:
    """Choose m points of every cloud of one size."""
    one_each = np.ones_like(starts)
    rows = farthest_rows(clouds, starts[:, None], one_each, m)
    if rows is None:
        raise UserError("x must be finite, got NaN or infinity.")
    return rows


def _on_device(x: "Tensor", counts: Rows, sizes: Rows, starts: Rows) -> "Tensor":
    """Choose points of clouds on a GPU."""
    import torch

    from mops_lightning.ops.fps import farthest_point_sample

    if not bool(x.isfinite().all()):
        raise UserError("x must be finite, got NaN or infinity.")
    if x.is_floating_point():
        floating = x.detach()
    else:
        floating = x.double()
    points = floating.reshape(len(x), -1)
    begins = counts.cumsum() - counts
    if _are_alike(counts, sizes):
        clouds = points.reshape(len(counts), int(counts[0]), -1)
        first = torch.from_numpy(starts).to(x.device)
        rows = farthest_point_sample(clouds, int(sizes[0]), first)
        begins_on_device = torch.from_numpy(begins).to(x.device)
        return (rows + begins_on_device[:, None]).flatten()
    clouds_of_points = points.split(counts.tolist())
    numbers = zip(sizes.tolist(), starts.tolist(), begins.tolist(), strict=True)
    rows_of_clouds = []
    for cloud, (m, start, begin) in zip(clouds_of_points, numbers, strict=True):
        if m > 0:
            rows = farthest_point_sample(cloud[None], m, start)[0]
            rows_of_clouds.append(rows + begin)
    return torch.cat(rows_of_clouds)
