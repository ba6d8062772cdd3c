"""Options of ``downsample`` at the limits of what is allowed."""

from math import inf, nan
from pathlib import Path
from typing import Any

import pytest

from mops_lightning.data.formats.area import Area
from mops_lightning.errors import UserError
from mops_lightning.files.arguments import check_out, counted, numbers, one_of
from mops_lightning.files.options import Options, parse_distance, parse_size, parse_space
from mops_lightning.files.strata import Strata

FPS: dict[str, Any] = {"m": 5, "method": "fps"}
LEARNED: dict[str, Any] = {"m": 5, "weights": "w"}
MAP = Path("map.npz")
CLASSES = Strata("class")

ALLOWED: dict[str, dict[str, Any]] = {
    "one point": {"m": 1, "method": "fps"},
    "number of the weights": {"weights": "w"},
    "small share": {"m": 1e-9, "method": "fps"},
    "large share": {"m": 0.999, "method": "fps"},
    "one point of a surface": {**FPS, "surface": 1},
    "smallest seed": {**FPS, "seed": 0},
    "largest seed": {**FPS, "seed": 2**63 - 1},
    "tile of two": {**FPS, "tile": 2},
    "chunk of m": {**FPS, "chunk": 5},
    "chunk below m of generated points": {**LEARNED, "chunk": 1, "readout": "generated"},
    "chunk below m of matched points": {**LEARNED, "chunk": 1, "readout": "matched"},
    "chunk of a share": {"m": 0.5, "method": "fps", "chunk": 1},
    "as many rows of a map as points": {**FPS, "map": MAP, "map_k": 5},
    "map in capitals": {**FPS, "map": Path("MAP.NPZ")},
    "spacing": {"spacing": 1e-9},
    "means of voxels": {"voxel": 2.0, "readout": "generated"},
    "spacing by tiles": {"spacing": 0.1, "tile": 64},
    "space of a spacing": {"spacing": 0.1, "space": (("x", 1.0),)},
    "space of tiles by a spacing": {"spacing": 0.1, "space": (("x", 1.0),), "tile": 64},
    "space of poisson": {"m": 5, "method": "poisson", "space": (("x", 1.0),)},
    "classes": {**FPS, "strata": CLASSES},
    "vertices": {**FPS, "vertices": True},
}

REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no point": ({"m": 0, "method": "fps"}, "--m must be a whole number of at least 1"),
    "no share": ({"m": 0.0, "method": "fps"}, "--m must be .* got 0.0"),
    "whole share": ({"m": 1.0, "method": "fps"}, "--m must be .* got 1.0"),
    "no number": ({"method": "fps"}, "--m must be .* got None"),
    "no budget": ({}, "give --method"),
    "no way": ({"m": 5}, "give --method"),
    "two ways": ({**FPS, "weights": "w"}, "give --weights or --method fps, not both"),
    "two budgets": ({"m": 5, "voxel": 1.0}, "give one of .* got --m and --voxel"),
    "two distances": ({"spacing": 5.0, "voxel": 1.0}, "got --spacing and --voxel"),
    "surface of no points": ({**FPS, "surface": 0}, "--surface must be at least 1, got 0"),
    "vertices and surface": ({**FPS, "surface": 9, "vertices": True}, "leave --surface out"),
    "negative seed": ({**FPS, "seed": -1}, "--seed must be from 0"),
    "large seed": ({**FPS, "seed": 2**63}, "--seed must be from 0"),
    "spacing of zero": ({"spacing": 0.0}, "--spacing must be a number above 0"),
    "endless voxel": ({"voxel": inf}, "--voxel must be a number above 0"),
    "voxel that is no number": ({"voxel": nan}, "--voxel must be a number above 0"),
    "spacing and method": ({"spacing": 1.0, "method": "fps"}, "--spacing needs neither"),
    "voxel and weights": ({"voxel": 1.0, "weights": "w"}, "--voxel needs neither"),
    "spacing of classes": ({"spacing": 1.0, "strata": CLASSES}, "no --spacing"),
    "generated spacing": ({"spacing": 1.0, "readout": "generated"}, "no --readout generated"),
    "matched voxels": ({"voxel": 1.0, "readout": "matched"}, "no --readout matched"),
    "weighted means": (
        {"voxel": 1.0, "readout": "generated", "weight": "w"},
        "the means of voxels take no weights",
    ),
    "generated classes": (
        {**LEARNED, "strata": CLASSES, "readout": "generated"},
        "--stratify keeps input points",
    ),
    "map of another format": ({**FPS, "map": Path("map.npy")}, "--map must end in .npz"),
    "more rows than points": ({**FPS, "map": MAP, "map_k": 6}, "--map-k must be from 1"),
    "no rows": ({**FPS, "map": MAP, "map_k": 0}, "--map-k must be from 1"),
    "rows without a map": ({**FPS, "map_k": 2}, "--map-k 2 has no effect"),
    "map of chunks": ({**FPS, "map": MAP, "chunk": 9}, "--map needs the whole cloud"),
    "map of an area": ({**FPS, "map": MAP, "area": Area(level=1)}, "no --bounds or level"),
    "tile of one": ({**FPS, "tile": 1}, "--tile must be at least 2"),
    "tile without a number": ({"weights": "w", "tile": 9}, "--tile needs --m"),
    "matched tiles": ({**LEARNED, "tile": 9, "readout": "matched"}, "no --readout matched"),
    "weighted tiles": ({**FPS, "tile": 9, "weight": "w"}, "leave --tile out"),
    "chunk of none": ({**FPS, "chunk": 0}, "--chunk must be at least 1"),
    "chunk below m": ({**FPS, "chunk": 4}, "--chunk must be at least --m 5, got 4"),
    "chunk below m of completed sets": ({**LEARNED, "chunk": 4}, "--chunk must be at least --m 5"),
    "space of random points": (
        {"m": 5, "method": "random", "space": (("x", 1.0),)},
        "--space is for --method fps, --method poisson and --spacing",
    ),
    "space of weights": ({**LEARNED, "space": (("x", 1.0),)}, "--space is for"),
    "space of voxels": ({"voxel": 1.0, "space": (("x", 1.0),)}, "--space is for"),
    "space of tiles": ({**FPS, "space": (("x", 1.0),), "tile": 9}, "leave --tile out"),
}


@pytest.mark.parametrize("given", ALLOWED.values(), ids=ALLOWED)
def test_options_at_their_limits_are_allowed(given):
    options = Options(**given)

    for name, value in given.items():
        assert getattr(options, name) == value


@pytest.mark.parametrize(("given", "said"), REFUSED.values(), ids=REFUSED)
def test_options_beyond_their_limits_are_refused(given, said):
    with pytest.raises(UserError, match=said):
        Options(**given)


@pytest.mark.parametrize(
    ("given", "draws"),
    [
        ({**FPS, "chunk": 9}, True),
        ({**LEARNED, "chunk": 9}, True),
        ({**LEARNED, "chunk": 9, "readout": "matched"}, False),
        ({"spacing": 1.0, "chunk": 9}, False),
        (FPS, False),
    ],
)
def test_options_draw_where_a_method_needs_all_points_at_once(given, draws):
    options = Options(**given)

    assert options.draws == draws


@pytest.mark.parametrize(
    ("given", "needs_columns"),
    [
        (FPS, True),
        ({**FPS, "coordinates_only": True}, False),
        ({**FPS, "coordinates_only": True, "weight": "w"}, True),
        ({**FPS, "coordinates_only": True, "strata": CLASSES}, True),
        ({**FPS, "coordinates_only": True, "space": (("x", 1.0),)}, True),
        ({**LEARNED, "coordinates_only": True}, True),
    ],
)
def test_options_need_columns_that_are_kept_or_decide(given, needs_columns):
    options = Options(**given)

    assert options.needs_columns == needs_columns


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("7", 7),
        ("0", 0),  # refused by Options, as a number of points
        ("10%", 0.1),
        ("0.5%", 0.005),
        ("99.9%", 0.999),
    ],
)
def test_parse_size_reads_numbers_and_shares(text, size):
    assert parse_size(text) == pytest.approx(size)
    assert type(parse_size(text)) is type(size)


@pytest.mark.parametrize("text", ["0%", "100%", "-1%", "10%%", "10%5", "0.5", "ten", "", "nan%"])
def test_parse_size_refuses_others(text):
    with pytest.raises(UserError, match="--m must be a whole number of at least 1, or a share"):
        parse_size(text)


def test_parse_distance_takes_numbers_without_a_unit():
    assert parse_distance("--voxel", "0.05") == 0.05
    with pytest.raises(UserError, match=r"--voxel must be a number above 0.* got '5cm'"):
        parse_distance("--voxel", "5cm")


@pytest.mark.parametrize(
    ("text", "factors"),
    [
        ("intensity", {"x": 1, "y": 1, "z": 1, "intensity": 1}),
        ("z=2, intensity=0.01", {"x": 1, "y": 1, "z": 2, "intensity": 0.01}),
        ("z=0", {"x": 1, "y": 1, "z": 0}),
    ],
)
def test_parse_space_has_all_coordinates(text, factors):
    assert dict(parse_space(text)) == factors


@pytest.mark.parametrize(
    "text", ["", "a,,b", "a=-1", "a=inf", "a=nan", "a=", "a=1,a=1", "x=1,x=2", "=2"]
)
def test_parse_space_refuses_others(text):
    with pytest.raises(UserError, match="--space must be columns with factors of at least 0"):
        parse_space(text)


def test_parse_space_refuses_zeros_alone():
    with pytest.raises(UserError, match="all factors are 0"):
        parse_space("x=0,y=0,z=0")


@pytest.mark.parametrize(
    ("text", "strata"),
    [
        ("class:share", Strata("class")),
        ("class:min=1", Strata("class", 1)),
        ("a:b:min=50", Strata("a:b", 50)),
    ],
)
def test_strata_are_a_column_and_a_rule(text, strata):
    assert Strata.parse(text) == strata


@pytest.mark.parametrize("text", ["class", ":share", "class:min=0", "class:50", "class:min=-1"])
def test_strata_of_another_form_are_refused(text):
    with pytest.raises(UserError, match="--stratify must be a column and a rule"):
        Strata.parse(text)


def test_arguments_are_read_and_counted():
    assert numbers("8") == [8]
    assert numbers("8,16, 32,") == [8, 16, 32]
    assert counted(1, "point") == "1 point"
    assert counted(0, "point") == "0 points"
    assert counted(1200, "point") == "1,200 points"
    assert one_of(None) is None
    assert one_of(["a"]) == "a"
    with pytest.raises(UserError, match="several --weights are for --task-net, got a, b"):
        one_of(["a", "b"])


def test_out_may_be_new_empty_or_an_earlier_comparison_on_request(tmp_path):
    (tmp_path / ".hidden").touch()
    check_out(tmp_path, overwrite=False)
    check_out(tmp_path / "new", overwrite=False)
    (tmp_path / "table.csv").touch()
    check_out(tmp_path, overwrite=True)

    with pytest.raises(UserError, match=r"table\.csv exists\. Give another, or --overwrite"):
        check_out(tmp_path, overwrite=False)
    (tmp_path / "mine.txt").touch()
    with pytest.raises(UserError, match=r"has other files, such as mine\.txt"):
        check_out(tmp_path, overwrite=True)
