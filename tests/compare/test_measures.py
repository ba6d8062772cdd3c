import numpy as np
import pytest

from mops_lightning.compare.measures import Reference, lowest, thin_parts
from mops_lightning.data.formats.table import Table


def plane_and_pole(number=3000):
    """A square floor of side 4 and a pole on it, 2 high."""
    random = np.random.default_rng(0)
    floor = np.c_[4 * random.random((number, 2)), np.zeros(number)]
    pole = np.c_[np.full((200, 2), 2.0), 0.3 + 2 * random.random(200)]
    return np.concatenate([floor, pole])


def test_reference_measures_by_hand():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [10, 0, 0]])
    columns = {"Intensity": np.array([0.0, 1, 2, 10]), "label": np.arange(4)}
    measures = Reference.of(Table(points, columns), np.array([0, 3])).measure(np.array([0, 3]))
    assert measures.chamfer == pytest.approx(3 / 4)
    assert measures.hausdorff == 2
    assert measures.density == pytest.approx(0.5)  # 3 points and 1 point
    assert measures.attributes == {"intensity": pytest.approx(0.75 / columns["Intensity"].std())}


def test_reference_everything_kept_has_no_error():
    points = plane_and_pole()
    rows = np.arange(len(points))
    measures = Reference.of(Table(points), rows[::20]).measure(rows)
    assert (measures.chamfer, measures.hausdorff, measures.density) == (0, 0, 0)
    assert measures.thin == 0
    assert measures.normals == pytest.approx(0, abs=1e-5)


def test_reference_missed_pole_shows_in_thin_parts():
    points = plane_and_pole()
    rows = np.arange(0, len(points), 10)
    reference = Reference.of(Table(points), rows)
    with_pole, without = reference.measure(rows), reference.measure(rows[rows < 3000])
    assert with_pole.thin is not None
    assert without.thin is not None
    assert with_pole.thin < 0.1 < 0.5 < without.thin
    assert without.chamfer < 0.2


def test_reference_normals_of_the_file_are_used():
    points = np.random.default_rng(0).normal(size=(50, 3))
    normals = {"nx": np.zeros(50), "ny": np.zeros(50), "nz": np.ones(50)}
    normals["nx"][:25], normals["nz"][:25] = 1, 0
    table = Table(points, normals)
    kept = np.arange(25)
    measures = Reference.of(table, kept).measure(kept)
    assert measures.normals == pytest.approx(45)
    assert measures.attributes == {}


@pytest.mark.parametrize("spacing", [0.2, 0.4])
def test_thin_parts_are_the_pole(spacing):
    points = plane_and_pole()
    thin = thin_parts(points, np.arange(len(points)), spacing)
    assert thin[:3000].mean() < 0.01
    assert thin[3000:].mean() > 0.6
    assert not thin_parts(points, np.arange(9), 0.0).any()


def test_lowest_ignores_missing_values_and_draws():
    assert lowest([3.0, None, 1.0]) == 2
    assert lowest([1.0, 1.0]) is None
    assert lowest([None]) is None


@pytest.mark.parametrize("far", [1e25, 1e200])
def test_thin_parts_with_a_stray_point_far_away(far):
    points = np.concatenate([plane_and_pole(), [[far, 0, 0]]])
    rows = np.arange(len(points))
    thin = thin_parts(points, rows, 0.2)
    assert thin[3000:3200].mean() > 0.9
    assert not thin[-1]
