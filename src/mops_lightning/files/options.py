"""Options of ``downsample``, checked."""

from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from mops_lightning.data.formats.area import Area
from mops_lightning.errors import UserError
from mops_lightning.files.strata import Strata
from mops_lightning.samplers.budget import Size, number_of
from mops_lightning.zoo.names import UNTRAINED


@dataclass(frozen=True)
class Options:
    """Options of downsampling a file.

    Attributes:
        m: number of points to keep, or their share, a float; None: as many as the weights were
            trained for, or a spacing or voxels.
        weights: of a trained sampler: a model, a weights file, or the folder of its run.
        method: one of ``zoo.names.UNTRAINED``, instead of weights.
        readout: of a trained sampler: generated, matched or completed; of voxels: generated means,
            or the points nearest to them.
        coordinates_only: leave out colours, normals and the like of the kept points.
        surface: number of points to sample from a mesh's surface first.
        seed: of random choices.
        chunk: number of points in memory; see ``draws``. None: the whole file.
        tile: most points of a tile; None: no tiles.
        map: file to write for ``mops_lightning.propagate``; None: no file.
        map_k: number of sampled points per point in this file.
        weight: a column with a weight per point, or ``curvature``; None: all points are equal.
        area: the part of the file to sample; None: all of it.
        columns: names of the columns of .bin files; None: those that their names imply.
        vertices: take the vertices of a mesh, instead of points on its surface.
        spacing: smallest distance of kept points, in the file's unit.
        voxel: side of voxels of which each keeps one point, in the file's unit.
        space: factors of columns that count in distances; None: the coordinates alone.
        strata: how the points of each class are kept; None: classes do not matter.
        overwrite: replace existing files.

    Raises:
        UserError: a value is out of range, or options exclude each other.
    """

    m: Size | None = None
    weights: str | None = None
    method: str | None = None
    readout: str = "completed"
    coordinates_only: bool = False
    surface: int | None = None
    seed: int = 0
    chunk: int | None = None
    tile: int | None = None
    map: Path | None = None
    map_k: int = 1
    weight: str | None = None
    area: Area | None = None
    columns: tuple[str, ...] | None = None
    vertices: bool = False
    spacing: float | None = None
    voxel: float | None = None
    space: tuple[tuple[str, float], ...] | None = None
    strata: Strata | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Reject values out of range and options that exclude each other."""
        self._check_budget()
        if self.surface is not None and self.surface < 1:
            raise UserError(f"--surface must be at least 1, got {self.surface}.")
        if self.vertices and self.surface is not None:
            raise UserError("--vertices takes the vertices of a mesh: leave --surface out.")
        if not 0 <= self.seed < 2**63:
            raise UserError(f"--seed must be from 0 to 2**63 - 1, got {self.seed}.")
        self._check_map()
        self._check_parts()
        self._check_space()

    def _check_budget(self) -> None:
        """Reject anything but one budget, and one way of keeping to it."""
        budgets = {
            "--m": self.m,
            "--spacing": self.spacing,
            "--voxel": self.voxel,
        }
        given = [name for name, value in budgets.items() if value is not None]
        if len(given) > 1:
            names = " and ".join(given)
            raise UserError(f"give one of --m, --spacing and --voxel, got {names}.")
        if self.is_by_distance:
            self._check_distance(given[0])
            return
        if self.weights is None and self.method is None:
            methods = "|".join(UNTRAINED)
            raise UserError(
                f"give --method {methods}, or --weights MODEL; or instead of --m "
                "--spacing or --voxel."
            )
        if self.weights is not None and self.method is not None:
            raise UserError(f"give --weights or --method {self.method}, not both.")
        is_missing = self.m is None and self.method is not None
        is_too_small = isinstance(self.m, int) and self.m < 1
        is_no_share = isinstance(self.m, float) and not 0 < self.m < 1
        if is_missing or is_too_small or is_no_share:
            raise UserError(
                "--m must be a whole number of at least 1, or a share of the points such as 10%, "
                f"got {self.m}."
            )
        if self.strata is not None and self.readout != "completed":
            raise UserError(f"--stratify keeps input points: no --readout {self.readout}.")

    def _check_distance(self, name: str) -> None:
        """Reject what a spacing or voxels exclude."""
        distance = self.spacing
        if distance is None:
            distance = self.voxel
        assert distance is not None
        if not (isfinite(distance) and distance > 0):
            raise UserError(f"{name} must be a number above 0, in the file's unit, got {distance}.")
        if self.weights is not None or self.method is not None:
            raise UserError(f"{name} needs neither --method nor --weights.")
        if self.strata is not None:
            raise UserError(f"--stratify shares a number of points among classes: no {name}.")
        is_mean_of_voxel = self.readout == "generated" and self.voxel is not None
        if self.readout != "completed" and not is_mean_of_voxel:
            raise UserError(f"{name} keeps input points: no --readout {self.readout}.")
        if self.readout == "generated" and self.weight is not None:
            raise UserError("--weight: the means of voxels take no weights.")

    def _check_map(self) -> None:
        """Reject a map of another format, or of more rows than points are kept."""
        if self.map is not None and self.map.suffix.lower() != ".npz":
            raise UserError(f"--map must end in .npz, got {self.map}.")
        is_too_large = isinstance(self.m, int) and self.map_k > self.m
        if self.map_k < 1 or is_too_large:
            raise UserError(f"--map-k must be from 1 to --m, got {self.map_k}.")
        if self.map is None and self.map_k != 1:
            raise UserError(f"--map-k {self.map_k} has no effect without --map FILE.npz.")

    def _check_parts(self) -> None:
        """Reject tiles and chunks out of range, or with options that they exclude."""
        if self.tile is not None and self.tile < 2:
            raise UserError(f"--tile must be at least 2, got {self.tile}.")
        tiles_by_number = self.tile is not None and not self.is_by_distance
        if tiles_by_number and self.m is None:
            raise UserError("--tile needs --m, the number of points to keep of all tiles together.")
        if tiles_by_number and self.readout != "completed":
            raise UserError(f"--tile keeps different input points: no --readout {self.readout}.")
        if tiles_by_number and self.weight is not None:
            raise UserError("--weight needs the whole cloud at once: leave --tile out.")
        if self.chunk is not None and self.map is not None:
            raise UserError("--map needs the whole cloud in memory: use propagate after --chunk.")
        if self.area is not None and self.map is not None:
            raise UserError("--map has a row for every point of IN: no --bounds or level with it.")
        if self.chunk is not None and self.chunk < 1:
            raise UserError(f"--chunk must be at least 1, got {self.chunk}.")
        if self.draws:
            self.check_chunk(self.m)

    def check_chunk(self, m: Size | None) -> None:
        """Reject more points than are drawn; a share is known once the file has been counted."""
        if isinstance(m, int) and m > (self.chunk or 0):
            raise UserError(f"--chunk must be at least --m {m}, got {self.chunk}.")

    def _check_space(self) -> None:
        if self.space is None:
            return
        takes_space = self.method in (None, "fps", "poisson") and self.weights is None
        if not takes_space or self.voxel is not None:
            raise UserError("--space is for --method fps, --method poisson and --spacing.")
        if self.tile is not None and not self.is_by_distance:
            raise UserError("--space needs the whole cloud at once: leave --tile out.")

    @property
    def is_by_distance(self) -> bool:
        """Whether a spacing or voxels decide how many points are kept."""
        return self.spacing is not None or self.voxel is not None

    @property
    def draws(self) -> bool:
        """Whether ``chunk`` random points of a file are drawn first, and sampled."""
        streams = self.weights is not None and self.readout != "completed"
        return self.chunk is not None and not streams and not self.is_by_distance

    @property
    def needs_columns(self) -> bool:
        """Whether attributes are kept, or decide which points are."""
        decides = (self.weight, self.space, self.strata, self.weights)
        is_decided_by_columns = any(setting is not None for setting in decides)
        return is_decided_by_columns or not self.coordinates_only

    def number(self, trained: int, points: int) -> int:
        """Return how many of so many points to keep.

        Args:
            trained: the number that the sampler was made for.
            points: number of points of the file.
        """
        if self.m is None:
            return trained
        return number_of(self.m, points)


def parse_size(text: str) -> Size:
    """Return the number of points, or their share such as 10%, of a command line.

    Raises:
        UserError: it is neither.
    """
    number, percent, rest = text.partition("%")
    try:
        if not percent:
            return int(number)
        share = float(number) / 100
    except ValueError:
        share = 0.0
    if rest or not 0 < share < 1:
        raise UserError(
            "--m must be a whole number of at least 1, or a share of the points above 0% and below "
            f"100%, got {text}."
        )
    return share


def parse_distance(name: str, text: str) -> float:
    """Return the number of a command line's ``--spacing`` or ``--voxel``.

    Raises:
        UserError: it is none, such as ``5cm``.
    """
    try:
        return float(text)
    except ValueError:
        raise UserError(
            f"{name} must be a number above 0, in the file's unit, such as 0.05, got {text!r}."
        ) from None


def parse_space(text: str) -> tuple[tuple[str, float], ...]:
    """Return the columns that count in distances, and their factors.

    Args:
        text: ``NAME`` or ``NAME=FACTOR``, separated by commas. The coordinates have factor 1
            unless they are named.

    Raises:
        UserError: a factor is no number of at least 0, or a name is given twice.
    """
    factors = {"x": 1.0, "y": 1.0, "z": 1.0}
    named = set()
    for word in text.split(","):
        name, equals, number = word.strip().partition("=")
        factor = 1.0
        if equals:
            factor = _factor(number)
        is_new = name != "" and name not in named
        if not is_new or not (isfinite(factor) and factor >= 0):
            raise UserError(
                f"--space must be columns with factors of at least 0, such as intensity=0.01,z=2, "
                f"got {text!r}."
            )
        named.add(name)
        factors[name] = factor
    if not any(factors.values()):
        raise UserError("--space: all factors are 0.")
    return tuple(factors.items())


def _factor(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return -1.0  # which is refused
