import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.files import compare
from mops_lightning.files.compare import compare_file, ground_error, options_by_method


def test_coverage_by_hand():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [10, 0, 0]])
    chamfer, hausdorff, density = compare.coverage(points, points[[0, 4]])
    assert chamfer == pytest.approx(6 / 5)
    assert hausdorff == 3
    assert density == pytest.approx(1.5 / 2.5)  # 4 points and 1 point
    assert compare.coverage(points, points) == (0, 0, 0)


def test_ground_error_of_plane_step_and_few_points():
    x, y = np.random.default_rng(0).uniform(0, 9, (2, 500)) + np.array([[5e5], [4e6]])
    plane = np.stack([x, y, 0.3 * (x - 5e5) - 0.2 * (y - 4e6) + 7], 1)
    corners = np.array([[0, 0], [9, 0], [0, 9], [9, 9]]) + np.array([5e5, 4e6])
    heights = corners @ [0.3, -0.2] - 0.3 * 5e5 + 0.2 * 4e6 + 7
    assert ground_error(plane, np.column_stack([corners, heights])) == pytest.approx(0, abs=1e-6)
    slope = np.array([[0.0, 0, 0], [1, 0, 1], [2, 0, 2], [3, 0, 5]])
    # A line has no triangles: the nearest heights are 0, 0, 2, 2.
    assert ground_error(slope, slope[[0, 2]]) == pytest.approx(np.sqrt((1 + 9) / 4))
    assert ground_error(slope, slope) == 0
    assert np.isnan(ground_error(slope, slope[:0]))


def test_ground_error_is_linear_inside_and_nearest_outside():
    kept = np.array([[0.0, 0, 0], [4, 0, 4], [0, 4, 8], [4, 4, 12]])
    inside, outside = [[1, 2, 5 + 3.0], [3, 3, 9.0]], [[-1, 0, 0.0], [6, 5, 13.0]]
    ground = np.concatenate([kept, inside, outside])
    assert ground_error(ground, kept) == pytest.approx(np.sqrt((3**2 + 0 + 0 + 1) / len(ground)))


def test_compare_measures_the_ground_of_airborne_scans_only(tmp_path):
    points = np.random.default_rng(0).uniform(0, 9, (400, 3))
    classes = np.repeat([1, 2], 200).astype(np.uint8)
    points[classes == 2, 2] = 1.0
    WRITERS[".las"](tmp_path / "air.las", Table(points, {"classification": classes}))
    WRITERS[".ply"](tmp_path / "one.ply", Table(points))
    methods = options_by_method(60, ["random"], None, None, 0)
    found = [compare_file(tmp_path / name, 60, methods, 0) for name in ("air.las", "one.ply")]
    assert found[0].results[0].ground == pytest.approx(0, abs=1e-6)
    assert found[1].results[0].ground is None
    table = compare.write_comparison(found, tmp_path)
    assert table.count("| ground |") == 1
    empty = [line.split(",")[7] == "" for line in (tmp_path / "table.csv").read_text().split()]
    assert empty == [False, False, True]


def test_compare_file_samples_once_before_it_measures_time(tmp_path, monkeypatch):
    """Imports and compilation belong to no method; the first one had them."""
    points = np.random.default_rng(0).normal(size=(700, 3))
    WRITERS[".ply"](tmp_path / "one.ply", Table(points))
    sizes, sample = [], compare.sample_cloud

    def noted(points, *rest, **named):
        sizes.append(len(points))
        return sample(points, *rest, **named)

    monkeypatch.setattr(compare, "sample_cloud", noted)
    methods = options_by_method(60, ["random", "fps"], None, None, 0)
    compare_file(tmp_path / "one.ply", 60, methods, 0)
    assert sizes == [120, 700] * 2
