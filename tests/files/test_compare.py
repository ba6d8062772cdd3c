import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.files import compare
from mops_lightning.files.compare import compare_file, coverage, options_by_method


def test_coverage_by_hand():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [10, 0, 0]])
    chamfer, hausdorff, density = coverage(points, points[[0, 3]])
    assert chamfer == pytest.approx(3 / 4)
    assert hausdorff == 2
    assert density == pytest.approx(0.5)  # 3 points and 1 point
    assert coverage(points, points) == (0, 0, 0)


def test_compare_file_samples_once_before_it_measures_time(tmp_path, monkeypatch):
    """Imports and compilation belong to no method; the first one had them."""
    points = np.random.default_rng(0).normal(size=(700, 3))
    WRITERS[".ply"](tmp_path / "one.ply", Table(points))
    sizes, sample = [], compare.sample_cloud

    def noted(points, *rest):
        sizes.append(len(points))
        return sample(points, *rest)

    monkeypatch.setattr(compare, "sample_cloud", noted)
    methods = options_by_method(60, ["random", "fps"], None, None, 0)
    compare_file(tmp_path / "one.ply", 60, methods, 0)
    assert sizes == [120, 700] * 2
