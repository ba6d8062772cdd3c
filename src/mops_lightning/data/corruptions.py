"""Corruptions of test clouds that need nothing but their points, at five severities.

The kinds and most levels follow two benchmarks, ModelNet-C (Ren et al., 2022) and ModelNet40-C (Sun
et al., 2022). Clouds are drawn and corrupted here, so that figures on their files do not compare.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from mops_lightning.channels import NO_CHANNELS, PointChannels, coordinates, with_coordinates
from mops_lightning.data.clouds import Clouds
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.ops.rigid import quaternion_to_matrix
from mops_lightning.seeding import generator

STREAM = 17
"""Random stream of the corruptions of test clouds."""


class Cloud(NamedTuple):
    """One cloud and what its channels are.

    Attributes:
        points: ``(N, 3 + C)``.
        channels: of the points.
    """

    points: Tensor
    channels: PointChannels

    @property
    def places(self) -> Tensor:
        """The coordinates ``(N, 3)``."""
        return coordinates(self.points)

    def at(self, places: Tensor) -> "Cloud":
        """Return the points at other coordinates."""
        return self._replace(points=with_coordinates(self.points, places))

    def mapped(self, matrix: Tensor) -> "Cloud":
        """Return the points times an invertible matrix; normals stay normal."""
        mapped = self.channels.mapped(self.points, matrix)
        return self._replace(points=mapped)

    def normalised(self) -> "Cloud":
        """Return the points in the unit sphere."""
        normalised = normalize_unit_sphere(self.places[None])
        return self.at(normalised[0])

    def without(self, rows: Tensor) -> "Cloud":
        """Return the points that are not in ``rows``."""
        kept = torch.ones(len(self.points), dtype=torch.bool)
        kept[rows] = False
        return self._replace(points=self.points[kept])

    def followed_by(self, places: Tensor, rng: torch.Generator) -> "Cloud":
        """Return the points and further ones, which have the channels of random points."""
        added = places
        if self.channels:
            number = len(places)
            rows = torch.randint(len(self.points), (number,), generator=rng)
            channels = self.points[rows, 3:]
            added = torch.cat([places, channels], 1)
        return self._replace(points=torch.cat([self.points, added]))


Corruption = Callable[[Cloud, float, torch.Generator], Cloud]
Levels = tuple[float, float, float, float, float]
SEVERITIES = ("1", "2", "3", "4", "5")
"""Corrupts a cloud at a level; the number of points returned depends on both only."""


def corrupt(clouds: Clouds, spec: str, channels: PointChannels = NO_CHANNELS) -> Clouds:
    """Corrupt every cloud of a split.

    The draw depends on the position of a cloud in the split only, so that every method is tested on
    the same clouds. Points that a corruption adds come last. Parts are kept where no point is
    added or removed. Normals turn with the surface, except under ``distortion``; other channels
    stay with their points.

    Args:
        clouds: a split, in the unit sphere.
        spec: kind and severity, such as ``shear-3``, of ``KINDS`` and 1 to 5.
        channels: of the points.

    Raises:
        UserError: there is no such kind or severity.
    """
    apply, level = parse(spec)
    if clouds.sizes is not None:
        raise UserError(
            f"test_corruption={spec} needs clouds of one size. Set dataset.n_points to a number."
        )
    corrupted = []
    for number, points in enumerate(clouds.points):
        rng = generator(STREAM, number)
        cloud = apply(Cloud(points, channels), level, rng)
        corrupted.append(cloud.points)
    stacked = torch.stack(corrupted)
    parts = None
    if stacked.shape == clouds.points.shape:  # the same points in the same order, moved
        parts = clouds.parts
    return clouds._replace(points=stacked, parts=parts)


def parse(spec: str) -> tuple[Corruption, float]:
    """Return the function and the level of ``KIND-SEVERITY``."""
    kind, _, severity = spec.rpartition("-")
    if kind not in KINDS or severity not in SEVERITIES:
        hint = ""
        if kind not in KINDS and spec not in KINDS:
            hint = did_you_mean(kind or spec, KINDS)
        raise UserError(
            "test_corruption must be a kind with a severity of 1 to 5, such as shear-3, got "
            f"{spec!r}.{hint}"
        )
    apply, levels = KINDS[kind]
    return apply, levels[int(severity) - 1]


def jitter(cloud: Cloud, std: float, rng: torch.Generator) -> Cloud:
    """Add Gaussian noise to every coordinate."""
    places = cloud.places
    noise = torch.randn(places.shape, generator=rng)
    return cloud.at(places + std * noise)


def rotation(cloud: Cloud, degrees: float, rng: torch.Generator) -> Cloud:
    """Rotate by an angle of up to ``degrees`` about a random axis."""
    axis = normalize(torch.randn(3, generator=rng), dim=0)
    angle = math.radians(degrees) * _uniform((1,), rng)
    half = angle / 2
    vector = half.sin() * axis
    quaternion = torch.cat([half.cos(), vector])
    return cloud.mapped(quaternion_to_matrix(quaternion))


def scaling(cloud: Cloud, factor: float, rng: torch.Generator) -> Cloud:
    """Scale each axis by a factor between ``1 / factor`` and ``factor``."""
    factors = factor ** _uniform((3,), rng)
    stretched = cloud.channels.stretched(cloud.points, factors)
    return cloud._replace(points=stretched).normalised()


def shear(cloud: Cloud, amount: float, rng: torch.Generator) -> Cloud:
    """Add multiples of the other coordinates, up to ``amount``, to every coordinate."""
    mixed = amount * _uniform((3, 3), rng)
    matrix = torch.eye(3) + mixed.fill_diagonal_(0)
    return cloud.mapped(matrix).normalised()


def distortion(cloud: Cloud, amount: float, rng: torch.Generator) -> Cloud:
    """Move the nodes of a lattice of 5 x 5 x 5 by up to ``amount``, and the points with them."""
    lattice = amount * _uniform((1, 3, 5, 5, 5), rng)
    places = cloud.places
    grid = places[None, None, None]
    offsets = grid_sample(lattice, grid, align_corners=True)
    moved = places + offsets[0, :, 0, 0].T
    return cloud.at(moved).normalised()


def density_down(cloud: Cloud, places: float, rng: torch.Generator) -> Cloud:
    """Thin the cloud to a quarter in ``places`` neighbourhoods of a tenth of the points."""
    size = len(cloud.points) // 10
    number_gone = round(0.75 * size)
    for _ in range(int(places)):
        near = _nearest(cloud, size, rng)
        order = torch.randperm(size, generator=rng)
        cloud = cloud.without(near[order[:number_gone]])
    return cloud


def density_up(cloud: Cloud, places: float, rng: torch.Generator) -> Cloud:
    """Thin the cloud outside of ``places`` neighbourhoods, by as many points as there go inside."""
    size = len(cloud.points) // 10
    number_gone = int(places) * round(0.75 * size)
    is_outside = torch.ones(len(cloud.points), dtype=torch.bool)
    for _ in range(int(places)):
        near = _nearest(cloud, size, rng)
        is_outside[near] = False
    rows = is_outside.nonzero()[:, 0]
    order = torch.randperm(len(rows), generator=rng)
    return cloud.without(rows[order[:number_gone]])


def cutout(cloud: Cloud, holes: float, rng: torch.Generator) -> Cloud:
    """Cut ``holes`` holes of three percent of the points each."""
    size = round(0.03 * len(cloud.points))
    for _ in range(int(holes)):
        near = _nearest(cloud, size, rng)
        cloud = cloud.without(near)
    return cloud


def drop_global(cloud: Cloud, share: float, rng: torch.Generator) -> Cloud:
    """Drop a share of the points at random."""
    number = len(cloud.points)
    number_gone = round(share * number)
    order = torch.randperm(number, generator=rng)
    return cloud.without(order[:number_gone])


def drop_local(cloud: Cloud, share: float, rng: torch.Generator) -> Cloud:
    """Drop a share of the points around one to eight places."""
    number_gone = round(share * len(cloud.points))
    for size in _split(number_gone, rng):
        near = _nearest(cloud, size, rng)
        cloud = cloud.without(near)
    return cloud


def add_global(cloud: Cloud, share: float, rng: torch.Generator) -> Cloud:
    """Add points that are uniform in the unit ball; ``share`` is relative to the cloud."""
    count = round(share * len(cloud.points))
    vectors = torch.randn(count, 3, generator=rng)
    direction = normalize(vectors, dim=1)
    volume = torch.rand(count, 1, generator=rng)
    radius = volume ** (1 / 3)
    return cloud.followed_by(radius * direction, rng)


def add_local(cloud: Cloud, share: float, rng: torch.Generator) -> Cloud:
    """Add points around one to eight points, at distances of about 0.1."""
    places = cloud.places
    total = round(share * len(places))
    added = []
    for size in _split(total, rng):
        row = torch.randint(len(places), (), generator=rng)
        std = 0.1 + 0.025 * _uniform((), rng)
        offsets = std * torch.randn(size, 3, generator=rng)
        added.append(places[row] + offsets)
    return cloud.followed_by(torch.cat(added), rng)


def background(cloud: Cloud, share: float, rng: torch.Generator) -> Cloud:
    """Add points that are uniform in the cube from -1 to 1."""
    count = round(share * len(cloud.points))
    places = _uniform((count, 3), rng)
    return cloud.followed_by(places, rng)


KINDS: dict[str, tuple[Corruption, Levels]] = {
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
    numbers = torch.rand(shape, generator=rng)
    return 2 * numbers - 1


def _nearest(cloud: Cloud, size: int, rng: torch.Generator) -> Tensor:
    """Return the rows of the points nearest to a random point."""
    places = cloud.places
    row = torch.randint(len(places), (), generator=rng)
    distances = (places - places[row]).norm(dim=1)
    return distances.topk(size, largest=False).indices


def _split(total: int, rng: torch.Generator) -> list[int]:
    """Divide a number into one to eight parts of random size."""
    parts = int(torch.randint(1, 9, (), generator=rng))
    owners = torch.randint(parts, (total,), generator=rng)
    return torch.bincount(owners, minlength=parts).tolist()
