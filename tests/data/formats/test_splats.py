"""Compressed splats, written by gsply."""

import signal

import gsply
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.data.formats import isolated
from mops_lightning.data.formats.registry import open_cloud_file, write
from mops_lightning.errors import UserError
from tests.support.cloud_files import contents


@pytest.fixture
def splats():
    """300 splats with coefficients of the first degree."""
    random = np.random.default_rng(0)

    def normal(*shape):
        return random.standard_normal(shape, np.float32)

    quats = normal(300, 4)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return gsply.GSData.from_arrays(
        means=normal(300, 3),
        scales=0.5 * normal(300, 3) - 4,
        quats=quats / lengths,
        opacities=normal(300),
        sh0=0.5 * normal(300, 3),
        shN=0.2 * normal(300, 3, 3),
    )


def test_plain_splat_file_is_kept_exactly(splats, tmp_path):
    source = tmp_path / "a.ply"
    copy = tmp_path / "b.ply"
    gsply.plywrite(source, splats)

    write(copy, contents(source))

    again = gsply.plyread(copy)
    assert_array_equal(again.means, splats.means)
    assert_array_equal(again.shN, splats.shN)
    assert_array_equal(again.quats, splats.quats)


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_compressed_splats_equal_those_that_gsply_unpacks(suffix, splats, tmp_path):
    packed = tmp_path / f"a{suffix}"
    plain = tmp_path / "plain.ply"
    if suffix == ".spz":
        gsply.write_spz(packed, splats)
        gsply.plywrite(plain, gsply.read_spz(packed))
    else:
        gsply.plywrite(packed, splats, compressed=True)
        gsply.plywrite(plain, gsply.plyread(packed))

    table = contents(packed)

    expected = contents(plain)
    assert_array_equal(table.points, expected.points)
    assert list(table.columns) == list(expected.columns)
    for name, column in expected.columns.items():
        assert_array_equal(table.columns[name], column)
    if suffix != ".spz":
        with pytest.raises(UserError, match="compressed PLY, which --chunk does not read"):
            open_cloud_file(packed)


def test_splat_is_refused_with_a_converter(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(bytes(64))

    with pytest.raises(UserError, match=r"\.splat is not read. Convert it by SuperSplat"):
        contents(path)


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="the system has no timer")
@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_time_to_compile_a_reader_is_not_time_to_read(suffix, splats, tmp_path, monkeypatch):
    path = tmp_path / f"a{suffix}"
    if suffix == ".spz":
        gsply.write_spz(path, splats)
    else:
        gsply.plywrite(path, splats, compressed=True)
    isolated._end_all()  # so that a new process has to import numba
    monkeypatch.setattr(isolated, "SECONDS", 0.0)

    table = contents(path)

    assert len(table.points) == 300
