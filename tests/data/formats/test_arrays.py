"""NumPy files."""

import numpy as np
import pytest

from mops_lightning.data.formats.registry import open_cloud_file, read
from mops_lightning.errors import UserError


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("shape", [(20, 10), ()])
def test_npy_fields_of_wrong_shape_are_rejected(shape, chunked, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros(shape, [("x", "f4"), ("y", "f4"), ("z", "f4")]))
    with pytest.raises(UserError, match="one row of fields"):
        open_cloud_file(path) if chunked else read(path, 9, 0)


@pytest.mark.parametrize("chunked", [True, False])
def test_npy_complex_coordinates_are_rejected(chunked, tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, np.zeros(20, [("x", "f4"), ("y", "c8"), ("z", "f4")]))
    with pytest.raises(UserError, match="y must be numbers, got complex64"):
        open_cloud_file(path).read(range(9)) if chunked else read(path, 9, 0)


def test_npy_fortran_order_is_rejected_in_chunks(tmp_path):
    np.save(tmp_path / "a.npy", np.asfortranarray(np.ones((90, 3))))
    with pytest.raises(UserError, match="C order"):
        open_cloud_file(tmp_path / "a.npy")
