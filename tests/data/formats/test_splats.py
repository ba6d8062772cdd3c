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
    quats = random.normal(size=(300, 4)).astype(np.float32)
    return gsply.GSData.from_arrays(
        means=random.normal(size=(300, 3)).astype(np.float32),
        scales=random.normal(-4, 0.5, (300, 3)).astype(np.float32),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacities=random.normal(size=300).astype(np.float32),
        sh0=random.normal(0, 0.5, (300, 3)).astype(np.float32),
        shN=random.normal(0, 0.2, (300, 3, 3)).astype(np.float32),
    )


def test_plain_splat_file_is_kept_exactly(splats, tmp_path):
    gsply.plywrite(tmp_path / "a.ply", splats)

    write(tmp_path / "b.ply", contents(tmp_path / "a.ply"))

    again = gsply.plyread(tmp_path / "b.ply")
    assert_array_equal(again.means, splats.means)
    assert_array_equal(again.shN, splats.shN)
    assert_array_equal(again.quats, splats.quats)


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply"])
def test_compressed_splats_equal_those_that_gsply_unpacks(suffix, splats, tmp_path):
    packed, plain = tmp_path / f"a{suffix}", tmp_path / "plain.ply"
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
    (tmp_path / "a.splat").write_bytes(bytes(64))

    with pytest.raises(UserError, match=r"\.splat is not read. Convert it by SuperSplat"):
        contents(tmp_path / "a.splat")


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
