from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mops_lightning.files import compare
from mops_lightning.files.compare import compare_file, ground_error, options_by_method
from mops_lightning.files.options import Options
from tests.support.cloud_files import write_cloud
from tests.support.clouds import normal_points


def test_coverage_by_hand():
    points = np.array(
        [
            [0.0, 0.0, 0.0],
            [1.0, 0.0, 0.0],
            [2.0, 0.0, 0.0],
            [3.0, 0.0, 0.0],
            [10.0, 0.0, 0.0],
        ]
    )
    kept = points[[0, 4]]

    chamfer, hausdorff, density = compare.coverage(points, kept)

    assert chamfer == pytest.approx((0 + 1 + 2 + 3 + 0) / 5)
    assert hausdorff == 3
    assert density == pytest.approx(1.5 / 2.5)  # 4 points and 1 point


def test_coverage_of_all_points_is_perfect():
    points = normal_points(5, 0)

    assert compare.coverage(points, points) == (0, 0, 0)


def with_heights_of_a_plane(x, y):
    """Return points of one plane in map coordinates."""
    heights = 0.3 * x - 0.2 * y + 7
    return np.column_stack([x + 5e5, y + 4e6, heights])


def test_ground_error_of_a_plane_is_zero():
    x, y = np.random.default_rng(0).uniform(0, 9, (2, 500))
    plane = with_heights_of_a_plane(x, y)
    corners = with_heights_of_a_plane(np.array([0, 9, 0, 9]), np.array([0, 0, 9, 9]))

    error = ground_error(plane, corners)

    assert error == pytest.approx(0, abs=1e-6)


SLOPE = np.array(
    [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 1.0],
        [2.0, 0.0, 2.0],
        [3.0, 0.0, 5.0],
    ]
)


def test_ground_error_of_a_line_takes_the_nearest_heights():
    kept = SLOPE[[0, 2]]

    error = ground_error(SLOPE, kept)

    # A line has no triangles: the nearest heights are 0, 0, 2, 2.
    assert error == pytest.approx(np.sqrt((0**2 + 1**2 + 0**2 + 3**2) / 4))
    assert ground_error(SLOPE, SLOPE) == 0


def test_ground_error_without_kept_points_is_not_a_number():
    assert np.isnan(ground_error(SLOPE, SLOPE[:0]))


def test_ground_error_is_linear_inside_and_nearest_outside():
    kept = np.array(
        [
            [0.0, 0.0, 0.0],
            [4.0, 0.0, 4.0],
            [0.0, 4.0, 8.0],
            [4.0, 4.0, 12.0],
        ]
    )
    others = np.array(
        [
            [1.0, 2.0, 5.0 + 3.0],
            [3.0, 3.0, 9.0],
            [-1.0, 0.0, 0.0],
            [6.0, 5.0, 12.0 + 1.0],
        ]
    )
    ground = np.concatenate([kept, others])

    error = ground_error(ground, kept)

    squares = 3**2 + 0**2 + 0**2 + 1**2
    assert error == pytest.approx(np.sqrt(squares / 8))


def test_compare_measures_the_ground_of_airborne_scans_only(tmp_path):
    airborne = tmp_path / "air.las"
    other = tmp_path / "one.ply"
    points = np.random.default_rng(0).uniform(0, 9, (400, 3))
    classes = np.repeat([1, 2], 200).astype(np.uint8)
    points[classes == 2, 2] = 1.0
    write_cloud(airborne, points, {"classification": classes})
    write_cloud(other, points)
    methods = options_by_method(60, ["random"], None, None, 0)

    of_airborne = compare_file(airborne, 60, methods, 0)
    of_other = compare_file(other, 60, methods, 0)
    table = compare.write_comparison([of_airborne, of_other], tmp_path)

    assert of_airborne.results[0].ground == pytest.approx(0, abs=1e-6)
    assert of_other.results[0].ground is None
    assert table.count("| ground |") == 1
    assert "- ground: " in table
    assert "- ground: " not in compare.write_comparison([of_other], tmp_path / "one")
    lines = (tmp_path / "table.csv").read_text().split()
    head, airborne_ground, other_ground = [line.split(",")[7] for line in lines]
    assert head != ""
    assert airborne_ground != ""
    assert other_ground == ""


def test_compare_file_samples_once_before_it_measures_time(tmp_path, monkeypatch):
    """Imports and compilation belong to no method; the first one had them."""
    path = tmp_path / "one.ply"
    points = normal_points(700, 0)
    write_cloud(path, points)
    sizes = []
    sample = compare.sample_cloud

    def noted(points, *rest, **named):
        sizes.append(len(points))
        return sample(points, *rest, **named)

    monkeypatch.setattr(compare, "sample_cloud", noted)
    methods = options_by_method(60, ["random", "fps"], None, None, 0)

    compare_file(path, 60, methods, 0)

    assert sizes == [120, 700, 120, 700]


MEASURES: dict[str, Any] = {
    "chamfer": 0.0,
    "hausdorff": 0.0,
    "density": 0.0,
    "ground": None,
    "seconds": 0.0,
}


def test_page_shows_the_input_and_the_last_method_with_z_upwards():
    points = np.array([[5.0, 0.0, 0.0], [7.0, 0.0, 0.0], [6.0, 2.0, 0.0], [6.0, -2.0, 4.0]])
    results = [
        compare.Result("fps", np.array([0, 3]), **MEASURES),
        compare.Result("trained", np.array([2, 1]), **MEASURES),
    ]
    compared = compare.FileResult(Path("scans/room.ply"), points, 2, results)

    clouds = compare._clouds(compared)

    # About the mean (6, 0, 1), divided by the largest coordinate, 3; y goes to the back.
    whole = [[-0.333, -0.333, 0.0], [0.333, -0.333, 0.0], [0.0, -0.333, -0.667], [0.0, 1.0, 0.667]]
    assert np.array(clouds["points"]["input"][0]) == pytest.approx(np.array(whole))
    assert np.array(clouds["points"]["fps"][0]) == pytest.approx(np.array([whole[0], whole[3]]))
    assert np.array(clouds["points"]["trained"][0]) == pytest.approx(np.array([whole[2], whole[1]]))
    assert clouds["name"] == "room.ply, 2 points"
    assert clouds["titles"] == ["room"]
    assert clouds["colours"] == {"input": "lightgrey"}
    assert clouds["hidden"] == ["fps"]


def test_page_shows_a_cloud_of_one_place():
    result = compare.Result("fps", np.array([0]), **MEASURES)
    compared = compare.FileResult(Path("a.ply"), np.full((2, 3), 7.0), 1, [result])

    clouds = compare._clouds(compared)

    assert clouds["points"]["fps"] == [[[0.0, 0.0, 0.0]]]


def test_methods_of_a_comparison_have_its_seed_and_the_trained_one_its_tile():
    methods = options_by_method(8, ["random", "fps"], "weights.pt", 64, 3)

    assert methods == {
        "fps": Options(8, method="fps", seed=3),
        "random": Options(8, method="random", seed=3),
        "trained": Options(8, "weights.pt", seed=3, tile=64),
    }
    assert list(methods) == ["fps", "random", "trained"]
