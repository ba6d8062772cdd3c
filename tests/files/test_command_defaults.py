"""What the commands of files do by default, and that every option is handed on."""

from pathlib import Path
from typing import Any

import pytest
from torch import nn

from mops_lightning.data.formats.area import Area
from mops_lightning.errors import UserError
from mops_lightning.files import cli, downsample_cli
from mops_lightning.files.arguments import parsed
from mops_lightning.files.icp.cli import _fill_defaults
from mops_lightning.files.options import Options
from mops_lightning.files.strata import Strata
from mops_lightning.files.task_net.compare import DRAWS
from mops_lightning.files.task_net.subject import subject_of_module


def downsample_arguments(*words):
    arguments = ["in.ply", "out.ply", *words]
    return parsed(arguments, "downsample", "", downsample_cli._downsample_arguments)


def test_downsample_has_the_defaults_of_its_options():
    chosen = downsample_arguments("--method", "fps", "--m", "5")

    assert downsample_cli._options(chosen) == Options(m=5, method="fps")
    assert (chosen.workers, chosen.cluster, chosen.total) == (1, None, False)


OPTIONS: list[tuple[list[str], dict[str, Any]]] = [
    (["--m", "7"], {"m": 7}),
    (["--m", "10%"], {"m": 0.1}),
    (["--readout", "matched"], {"readout": "matched"}),
    (["--coordinates-only"], {"coordinates_only": True}),
    (["--surface", "60"], {"surface": 60}),
    (["--vertices"], {"vertices": True}),
    (["--columns", "x, y,z,ring"], {"columns": ("x", "y", "z", "ring")}),
    (["--tile", "64"], {"tile": 64}),
    (["--chunk", "60"], {"chunk": 60}),
    (["--map", "map.npz", "--map-k", "3"], {"map": Path("map.npz"), "map_k": 3}),
    (["--weight", "intensity"], {"weight": "intensity"}),
    (["--stratify", "class:min=2"], {"strata": Strata("class", 2)}),
    (["--seed", "3"], {"seed": 3}),
    (["--overwrite"], {"overwrite": True}),
    (["--level", "2"], {"area": Area(level=2)}),
    (["--resolution", "0.5"], {"area": Area(resolution=0.5)}),
    (
        ["--bounds", "0,1,2,3,4,5", "--level", "2"],
        {"area": Area((0, 1, 2), (3, 4, 5), level=2)},
    ),
    (
        ["--bounds", "0,1,2,3,4,5", "--resolution", "0.5"],
        {"area": Area((0, 1, 2), (3, 4, 5), resolution=0.5)},
    ),
]


@pytest.mark.parametrize(("words", "expected"), OPTIONS)
def test_downsample_hands_every_option_on(words, expected):
    chosen = downsample_arguments("--weights", "w", "--m", "5", *words)

    options = downsample_cli._options(chosen)

    assert options == Options(**{"weights": "w", "m": 5, **expected})


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--spacing", "0.5"], {"spacing": 0.5}),
        (["--voxel", "0.5"], {"voxel": 0.5}),
        (
            ["--spacing", "0.5", "--space", "z=2"],
            {"spacing": 0.5, "space": (("x", 1.0), ("y", 1.0), ("z", 2.0))},
        ),
    ],
)
def test_downsample_hands_distances_on(words, expected):
    chosen = downsample_arguments(*words)

    assert downsample_cli._options(chosen) == Options(**expected)


def test_propagate_copies_the_nearest_value_by_default():
    words = ["small.ply", "big.ply", "--field", "label"]

    chosen = parsed(words, "propagate", "", cli._propagate_arguments)

    assert vars(chosen) == {
        "small": Path("small.ply"),
        "big": Path("big.ply"),
        "target": None,
        "field": ["label"],
        "k": 1,
        "columns": None,
        "mean": False,
        "overwrite": False,
    }


def compare_arguments(*words):
    return cli.compare_arguments(["scans", "--m", "8", *words], "compare")


def test_compare_measures_coverage_by_default():
    chosen = compare_arguments()

    given = {name: value for name, value in vars(chosen).items() if value is not None}
    assert given == {
        "files": [Path("scans")],
        "task": "coverage",
        "m": [[8]],
        "out": Path("compare"),
        "seed": 0,
        "overwrite": False,
    }


LEAST = {"draws": 1, "motions": 1, "crops": 1, "points": 20}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            [],
            {
                "draws": 10,
                "motions": 1,
                "registration": ["plane", "gicp"],
                "crops": 32,
                "points": 1024,
                "angle": 15.0,
                "shift": 0.1,
                "max_distance": 0.3,
                "sample_target": None,
            },
        ),
        (
            ["--poses", "poses.txt"],
            {
                "draws": 10,
                "motions": 1,
                "registration": ["plane", "gicp"],
                "crops": None,
                "points": None,
                "angle": 2.0,
                "shift": 0.5,
                "max_distance": 1.0,
                "sample_target": None,
            },
        ),
    ],
    ids=["crops", "frames"],
)
def test_compare_icp_fills_in_what_its_help_says(words, expected):
    chosen = compare_arguments("--task", "icp", *words)

    _fill_defaults(chosen)

    found = {name: getattr(chosen, name) for name in expected}
    assert found == expected


@pytest.mark.parametrize(("name", "least"), LEAST.items())
def test_compare_icp_takes_the_least_numbers_and_none_below(name, least):
    allowed = compare_arguments("--task", "icp", f"--{name}", str(least))
    below = compare_arguments("--task", "icp", f"--{name}", str(least - 1))

    _fill_defaults(allowed)

    assert getattr(allowed, name) == least
    with pytest.raises(UserError, match=f"--{name} must be at least {least}, got {least - 1}"):
        _fill_defaults(below)


def test_help_of_compare_names_the_defaults_of_icp():
    helps = {}

    def declare(name: str, **settings: Any) -> None:
        helps[name] = settings.get("help", "")

    cli._compare_arguments(declare)

    assert "default: 10, --task-net 5" in helps["--draws"]
    assert "default: 32, --task-net 8" in helps["--crops"]
    assert "default: 1024" in helps["--points"]
    assert "default: 1" in helps["--motions"]
    assert "default: 15, of frames 2" in helps["--angle"]
    assert "default: 0.1 of a crop's radius, of frames 0.5" in helps["--shift"]
    assert "default: 0.3 of a crop's radius, of frames 1" in helps["--max-distance"]


def test_compare_by_a_net_of_ones_own_has_eight_crops_of_1024_points():
    subject = subject_of_module(nn.Identity(), lambda output, batch: output, None, None, None)

    assert (subject.n_points, subject.crop, subject.crops) == (1024, "nearest", 8)
    assert DRAWS == 5
