"""Corruptions of test clouds that need nothing but their points, at five severities.

The kinds and most levels follow two benchmarks, ModelNet-C (Ren et al., 2022) and ModelNet40-C (Sun
et al., 2022). Clouds are drawn and corrupted here, so that figures on their files do not compare.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mops_lightning.data.clouds import Clouds
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.ops.rigid import quaternion_to_matrix
from mops_lightning.seeding import generator

STREAM = 17
"""Random stream of the corruptions of test clouds."""

Corruption = Callable[[Tensor, float, torch.Generator], Tensor]
"""Corrupts a cloud ``(N, 3)`` at a level; the number of points returned depends on both only."""


def corrupt(clouds: Clouds, spec: str) -> Clouds:
    """Corrupt every cloud of a split.

    The draw depends on the position of a cloud in the split only, so that every method is tested on
    the same clouds. Points that a corruption adds come last. Parts are kept where no point is
    added or removed.

    Args:
        clouds: a split, in the unit sphere.
        spec: kind and severity, such as ``shear-3``, of ``KINDS`` and 1 to 5.

    Raises:
        UserError: there is no such kind or severity.
    """
    apply, level = parse(spec)
    points = [apply(cloud, level, generator(STREAM, s)) for s, cloud in enumerate(clouds.points)]
    stacked = torch.stack(points)
    same = stacked.shape == clouds.points.shape  # the same points in the same order, moved
    return clouds._replace(points=stacked, parts=clouds.parts if same else None)


def parse(spec: str) -> tuple[Corruption, float]:
    """Return the function and the level of ``KIND-SEVERITY``."""
    kind, _, severity = spec.rpartition("-")
    if kind not in KINDS or severity not in ("1", "2", "3", "4", "5"):
        known = kind in KINDS or spec in KINDS
        raise UserError(
            "test_corruption must be a kind with a severity of 1 to 5, such as shear-3, got "
            f"{spec!r}.{'' if known else did_you_mean(kind or spec, KINDS)}"
        )
    apply, levels = KINDS[kind]
    return apply, levels[int(severity) - 1]


def jitter(points: Tensor, std: float, rng: torch.Generator) -> Tensor:
    """Add Gaussian noise to every coordinate."""
    return points + std * torch.randn(points.shape, generator=rng)


def rotation(points: Tensor, degrees: float, rng: torch.Generator) -> Tensor:
    """Rotate by an angle of up to ``degrees`` about a random axis."""
    axis = normalize(torch.randn(3, generator=rng), dim=0)
    half = math.radians(degrees) * _uniform((1,), rng) / 2
    return points @ quaternion_to_matrix(torch.cat([half.cos(), half.sin() * axis]))


def scaling(points: Tensor, factor: float, rng: torch.Generator) -> Tensor:
    """Scale each axis by a factor between ``1 / factor`` and ``factor``."""
    return _normalised(points * factor ** _uniform((3,), rng))


def shear(points: Tensor, amount: float, rng: torch.Generator) -> Tensor:
    """Add multiples of the other coordinates, up to ``amount``, to every coordinate."""
    mixed = amount * _uniform((3, 3), rng)
    return _normalised(points @ (torch.eye(3) + mixed.fill_diagonal_(0)))


def distortion(points: Tensor, amount: float, rng: torch.Generator) -> Tensor:
    """Move the nodes of a lattice of 5 x 5 x 5 by up to ``amount``, and the points with them."""
    lattice = amount * _uniform((1, 3, 5, 5, 5), rng)
    moved = grid_sample(lattice, points[None, None, None], align_corners=True)
    return _normalised(points + moved[0, :, 0, 0].T)


def density_down(points: Tensor, places: float, rng: torch.Generator) -> Tensor:
    """Thin the cloud to a quarter in ``places`` neighbourhoods of a tenth of the points."""
    size = len(points) // 10
    for _ in range(int(places)):
        near = _nearest(points, size, rng)
        gone = near[torch.randperm(size, generator=rng)[: round(0.75 * size)]]
        points = _without(points, gone)
    return points


def density_up(points: Tensor, places: float, rng: torch.Generator) -> Tensor:
    """Thin the cloud outside of ``places`` neighbourhoods, by as many points as there go inside."""
    size = len(points) // 10
    outside = torch.ones(len(points), dtype=torch.bool)
    for _ in range(int(places)):
        outside[_nearest(points, size, rng)] = False
    rows = outside.nonzero()[:, 0]
    gone = rows[torch.randperm(len(rows), generator=rng)[: int(places) * round(0.75 * size)]]
    return _without(points, gone)


def cutout(points: Tensor, holes: float, rng: torch.Generator) -> Tensor:
    """Cut ``holes`` holes of three percent of the points each."""
    size = round(0.03 * len(points))
    for _ in range(int(holes)):
        points = _without(points, _nearest(points, size, rng))
    return points


def drop_global(points: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Drop a share of the points at random."""
    order = torch.randperm(len(points), generator=rng)
    return _without(points, order[: round(share * len(points))])


def drop_local(points: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Drop a share of the points around one to eight places."""
    for size in _split(round(share * len(points)), rng):
        points = _without(points, _nearest(points, size, rng))
    return points


def add_global(points: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Add points that are uniform in the unit ball; ``share`` is relative to the cloud."""
    count = round(share * len(points))
    direction = normalize(torch.randn(count, 3, generator=rng), dim=1)
    radius = torch.rand(count, 1, generator=rng) ** (1 / 3)
    return torch.cat([points, radius * direction])


def add_local(points: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Add points around one to eight points, at distances of about 0.1."""
    added = []
    for size in _split(round(share * len(points)), rng):
        centre = points[torch.randint(len(points), (), generator=rng)]
        std = 0.1 + 0.025 * _uniform((), rng)
        added.append(centre + std * torch.randn(size, 3, generator=rng))
    return torch.cat([points, *added])


def background(points: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Add points that are uniform in the cube from -1 to 1."""
    return torch.cat([points, _uniform((round(share * len(points)), 3), rng)])


KINDS: dict[str, tuple[Corruption, tuple[float, float, float, float, float]]] = {
    "jitter": (jitter, (0.01, 0.02, 0.03, 0.04, 0.05)),
    "rotation": (rotation, (15, 30, 60, 90, 180)),
    "scaling": (scaling, (1.6, 1.7, 1.8, 1.9, 2.0)),
    "shear": (shear, (0.05, 0.1, 0.15, 0.2, 0.25)),
    "distortion": (distortion, (0.1, 0.2, 0.3, 0.4, 0.5)),
    "density_down": (density_down, (1, 2, 3, 4, 5)),
    "density_up": (density_up, (1, 2, 3, 4, 5)),
    "cutout": (cutout, (2, 3, 5, 7, 10)),
    "drop_global": (drop_global, (0.25, 0.375, 0.5, 0.625, 0.75)),
    "drop_local": (drop_local, (0.1, 0.2, 0.3, 0.4, 0.5)),
    "add_global": (add_global, (0.01, 0.02, 0.03, 0.04, 0.05)),
    "add_local": (add_local, (0.1, 0.2, 0.3, 0.4, 0.5)),
    "background": (background, (1 / 45, 1 / 40, 1 / 35, 1 / 30, 1 / 20)),
}
"""Every kind with its function and its levels at severities 1 to 5."""


def _uniform(shape: tuple[int, ...], rng: torch.Generator) -> Tensor:
    """Draw from -1 to 1."""
    return 2 * torch.rand(shape, generator=rng) - 1


def _normalised(points: Tensor) -> Tensor:
    return normalize_unit_sphere(points[None])[0]


def _nearest(points: Tensor, size: int, rng: torch.Generator) -> Tensor:
    """Return the rows of the points nearest to a random point."""
    centre = points[torch.randint(len(points), (), generator=rng)]
    return (points - centre).norm(dim=1).topk(size, largest=False).indices


def _without(points: Tensor, rows: Tensor) -> Tensor:
    kept = torch.ones(len(points), dtype=torch.bool)
    kept[rows] = False
    return points[kept]


def _split(total: int, rng: torch.Generator) -> list[int]:
    """Divide a number into one to eight parts of random size."""
    parts = int(torch.randint(1, 9, (), generator=rng))
    owners = torch.randint(parts, (total,), generator=rng)
    return torch.bincount(owners, minlength=parts).tolist()
