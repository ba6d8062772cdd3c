"""NumPy files."""

from typing import Any

import laspy
import numpy as np
import pytest

from mops_lightning.data.formats.registry import open_cloud_file
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents, write_table


def first_rows(path):
    """Read the beginning of a file, as ``--chunk`` does."""
    return open_cloud_file(path).read(range(9))


READERS = pytest.mark.parametrize("reader", [first_rows, contents], ids=["True", "False"])


@READERS
@pytest.mark.parametrize("shape", [(20, 10), ()])
def test_npy_fields_of_wrong_shape_are_rejected(shape, reader, tmp_path):
    path = tmp_path / "a.npy"
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4")]
    np.save(path, np.zeros(shape, fields))

    with pytest.raises(UserError, match="one row of fields"):
        reader(path)


@READERS
def test_npy_complex_coordinates_are_rejected(reader, tmp_path):
    path = tmp_path / "a.npy"
    fields = [("x", "f4"), ("y", "c8"), ("z", "f4")]
    np.save(path, np.zeros(20, fields))

    with pytest.raises(UserError, match="y must be numbers, got complex64"):
        reader(path)


def test_npy_fortran_order_is_rejected_in_chunks(tmp_path):
    path = tmp_path / "a.npy"
    by_column = np.asfortranarray(np.ones((90, 3)))
    np.save(path, by_column)

    with pytest.raises(UserError, match="C order"):
        open_cloud_file(path)


@pytest.mark.parametrize("kind", ["las", "laz", "copc.laz"])
def test_npz_arrays_become_dimensions_of_las_and_arrays_again(kind, tmp_path):
    source = tmp_path / "in.npz"
    path = tmp_path / f"cloud.{kind}"
    target = tmp_path / "back.npz"
    rng = np.random.default_rng(0)
    scores = rng.random((20, 4), np.float32)
    number = np.arange(20)
    named_alike: dict[str, Any] = {
        "normals": rng.random((20, 3), np.float32),
        "uv": rng.random((20, 2)),
        "rgb": rng.integers(0, 256, (20, 3), np.uint8),
        "classification": np.uint8(number % 6),
        "intensity": np.uint16(number * 3000),
    }
    points = np.arange(60.0).reshape(20, 3)
    np.savez(source, points=points, **named_alike, scores=scores)

    write_table(path, contents(source))
    write_table(target, contents(path))

    las = laspy.read(path)
    back = np.load(target)
    order = np.argsort(np.asarray(las.x))  # COPC sorts the points
    extra = list(las.point_format.extra_dimension_names)
    scores_apart = ["scores_0", "scores_1", "scores_2", "scores_3"]
    assert extra == ["normals", "uv", "rgb", *scores_apart]
    for name, values in named_alike.items():
        in_las = np.asarray(las[name])
        in_npz = back[name]
        assert np.array_equal(in_las[order], values)
        assert np.array_equal(in_npz[order], values)
        assert in_npz.dtype == values.dtype
    joined_scores = np.column_stack([back[name] for name in scores_apart])
    assert np.array_equal(joined_scores[order], scores)


@pytest.mark.parametrize(("largest", "version"), [(31, "1.2"), (200, "1.4")])
def test_classes_of_npz_decide_the_version_of_las(largest, version, tmp_path):
    source = tmp_path / "in.npz"
    target = tmp_path / "out.las"
    classes = np.array([1, 2, largest], np.uint8)
    np.savez(source, points=np.eye(3), classification=classes)

    write_table(target, contents(source))

    las = laspy.read(target)
    assert str(las.header.version) == version
    assert list(las.classification) == [1, 2, largest]
    assert not list(las.point_format.extra_dimension_names)
