"""``compare --task icp``: methods of downsampling by the registration of scans."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path

from mops_lightning.errors import UserError, check_at_least
from mops_lightning.files.arguments import Add, columns_of, one_of

REGISTRATIONS = ("plane", "gicp")

CROPS = {
    "crops": 32,
    "points": 1024,
    "angle": 15.0,
    "shift": 0.1,
    "max_distance": 0.3,
}
"""Defaults for crops, in radii of a crop."""

FRAMES = {
    "angle": 2.0,
    "shift": 0.5,
    "max_distance": 1.0,
}
"""Defaults for frames, in the files' unit."""

ONLY_ICP = (
    "poses",
    "sample_target",
    "motions",
    "angle",
    "shift",
    "max_distance",
    "registration",
)
"""Options of this task alone."""


def add_arguments(add: Add) -> None:
    """Declare the options that ``--task icp`` alone has."""
    add(
        "--poses",
        type=Path,
        metavar="FILE",
        help="icp: align consecutive frames, whose poses are here, a line each (KITTI or TUM), "
        "instead of halves of crops",
    )
    add(
        "--sample-target",
        action="store_true",
        default=None,
        help="icp: sample the target like the source; small_gicp then estimates its normals from "
        "the sample. Default: all points of the target",
    )
    add("--motions", type=int, metavar="N", help="icp: starts of every pair; default: 1")
    add(
        "--angle",
        type=float,
        metavar="DEGREES",
        help="icp: largest angle of a start; default: 15, of frames 2",
    )
    add(
        "--shift",
        type=float,
        metavar="DISTANCE",
        help="icp: largest shift of a start; default: 0.1 of a crop's radius, of frames 0.5",
    )
    add(
        "--max-distance",
        type=float,
        metavar="DISTANCE",
        help="icp: of corresponding points; default: 0.3 of a crop's radius, of frames 1",
    )
    add(
        "--registration",
        nargs="+",
        choices=REGISTRATIONS,
        help="icp: point-to-plane ICP, GICP; default: both",
    )


def compare_icp(chosen: argparse.Namespace) -> str:
    """Compare methods by registration, write the files and return the table as text.

    Raises:
        UserError: an argument or a file is invalid.
    """
    folder = _folder(chosen)
    _fill_defaults(chosen)
    from mops_lightning.files.icp.align import small_gicp
    from mops_lightning.files.icp.measure import Setup, compare_by_icp
    from mops_lightning.files.icp.methods import NAMES, methods_of
    from mops_lightning.files.icp.pairs import read_points, scans_of
    from mops_lightning.files.icp.poses import read_poses
    from mops_lightning.files.icp.tables import write_scores

    small_gicp()  # reports that it is missing before any file is read
    if chosen.poses is not None:
        read_poses(chosen.poses)  # reports its mistakes before any scan is read
    names = chosen.methods or NAMES
    weights = one_of(chosen.weights)
    setup = Setup(
        sizes=chosen.m,
        methods=methods_of(names, weights, chosen.tile, chosen.m),
        registrations=chosen.registration,
        draws=chosen.draws,
        motions=chosen.motions,
        angle=chosen.angle,
        shift=chosen.shift,
        max_distance=chosen.max_distance,
        is_target_sampled=bool(chosen.sample_target),
        seed=chosen.seed,
    )
    columns = columns_of(chosen)
    largest = chosen.points or max(chosen.m)
    surface = max(10_000, 8 * largest)
    scans = []
    for path in scans_of(folder):
        scans.append((path, read_points(path, chosen.seed, columns, surface)))
    pairs_of_draw = _pairs(chosen, scans)
    scores = list(compare_by_icp(pairs_of_draw, setup))
    return write_scores(scores, chosen.out)


def _folder(chosen: argparse.Namespace) -> Path:
    """Check the paths before libraries and samplers are loaded."""
    if len(chosen.files) != 1:
        raise UserError(f"--task icp takes one folder of scans, got {len(chosen.files)} paths.")
    folder: Path = chosen.files[0]
    if not folder.is_dir():
        raise UserError(f"--task icp takes one folder of scans, got {folder}.")
    return folder


def _pairs(chosen: argparse.Namespace, scans: list) -> Callable[[int], list]:
    """Return the function that gives the pairs of a draw."""
    from mops_lightning.files.icp.pairs import crop_pairs, frame_pairs
    from mops_lightning.seeding import derive_seed

    if chosen.poses is not None:
        pairs = frame_pairs(scans, chosen.poses)
        return lambda draw: pairs
    draw_crops = partial(crop_pairs, scans, chosen.points, chosen.crops)
    return lambda draw: draw_crops(derive_seed(chosen.seed, draw))


def _fill_defaults(chosen: argparse.Namespace) -> None:
    """Set what was not given, and check what was.

    Raises:
        UserError: a value is out of range.
    """
    defaults = CROPS
    if chosen.poses is not None:
        defaults = FRAMES
        for name in ("crops", "points"):
            if getattr(chosen, name) is not None:
                raise UserError(f"--{name} is for crops: leave it out with --poses.")
    common = {"draws": 10, "motions": 1, "registration": list(REGISTRATIONS)}
    for name, value in (common | defaults).items():
        if getattr(chosen, name) is None:
            setattr(chosen, name, value)
    fewest = {"draws": 1, "motions": 1, "crops": 1, "points": 20}
    for name, least in fewest.items():
        number = getattr(chosen, name)
        if number is not None and number < least:
            raise UserError(f"--{name} must be at least {least}, got {number}.")
    check_at_least(0, **{"--angle": chosen.angle, "--shift": chosen.shift})
    if not 0 < chosen.max_distance < float("inf"):
        raise UserError(f"--max-distance must be a number above 0, got {chosen.max_distance}.")
