"""Every point format of LAS on every path: all bytes of a point and of the header are kept."""

import laspy
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mops_lightning.files.cli import propagate
from tests.support import captured
from tests.support.downsample import done, refused
from tests.support.las import WAVEFORM_FORMATS, full_cloud, header_fields

PACKED_FORMATS = [form for form in range(11) if form not in WAVEFORM_FORMATS]
FILES = [(form, ".las") for form in range(11)]
FILES += [(form, ".laz") for form in PACKED_FORMATS]
PATHS = {
    "whole": ["--method", "fps", "--m", 40],
    "chunk": ["--method", "random", "--m", 40, "--chunk", 90],
    "tile": ["--method", "fps", "--tile", 64, "--m", 40],
    "bounds": ["--method", "random", "--m", 40, "--bounds", "499950,5399950,500040,5400040"],
}


@pytest.fixture(scope="module", params=FILES, ids=lambda pair: f"{pair[0]}{pair[1]}")
def scan(request, tmp_path_factory):
    form, suffix = request.param
    path = tmp_path_factory.mktemp("scan") / f"scan{suffix}"
    full_cloud(form).write(path)
    return path


def check_copy(source, copy, number):
    """Check that a copy has rows of its source, and a header that fits them."""
    before = laspy.read(source)
    after = laspy.read(copy)
    rows = np.asarray(after.point_source_id)
    assert len(after.points) == number
    given = before.points.array
    kept = after.points.array
    assert kept.dtype == given.dtype
    assert_array_equal(kept, given[rows])
    assert header_fields(copy) == header_fields(source)
    header = after.header
    low = after.xyz.min(0)
    high = after.xyz.max(0)
    assert_array_equal(header.mins, low)
    assert_array_equal(header.maxs, high)
    returns = np.bincount(after.return_number, minlength=16)[1:]
    most = 5
    if header.version.minor >= 4:
        most = 15
    by_return = header.number_of_points_by_return
    assert_array_equal(by_return[:most], returns[:most])


@pytest.mark.parametrize("path", PATHS)
def test_downsampled_points_keep_all_bytes(scan, path, tmp_path):
    target = tmp_path / f"out{scan.suffix}"

    done(scan, target, *PATHS[path])

    check_copy(scan, target, 40)


def test_propagated_file_keeps_all_bytes_but_the_field(scan, tmp_path):
    target = tmp_path / f"out{scan.suffix}"

    captured.done(propagate, [scan, scan, target, "--field", "classification"])

    check_copy(scan, target, 300)


@pytest.mark.parametrize("form", range(11))
def test_cluster_keeps_all_bytes(form, client, tmp_path):
    scan = tmp_path / "scan.las"
    target = tmp_path / "out.las"
    full_cloud(form).write(scan)

    done(scan, target, *PATHS["chunk"], "--cluster", client.scheduler.address)

    check_copy(scan, target, 40)


def test_propagate_sets_an_element_of_an_array_and_adds_a_dimension(tmp_path):
    scan = tmp_path / "scan.laz"
    small = tmp_path / "small.npz"
    out = tmp_path / "out.laz"
    colour = np.arange(300) % 200
    label = np.arange(300) - 7
    cloud = full_cloud(7)
    cloud.write(scan)
    np.savez(small, points=cloud.xyz, Colors_1=colour, label=label)

    captured.done(propagate, [small, scan, out, "--field", "Colors_1", "--field", "label"])

    again = laspy.read(out)
    colours = again["Colors"]
    old_colours = cloud["Colors"]
    assert_array_equal(again["label"], label)
    assert_array_equal(colours[:, 0], old_colours[:, 0])
    assert_array_equal(colours[:, 1], colour)
    assert_array_equal(colours[:, 2], old_colours[:, 2])
    assert_array_equal(again["long steps"].array, cloud["long steps"].array)


@pytest.mark.parametrize("form", WAVEFORM_FORMATS)
@pytest.mark.parametrize("name", ["out.laz", "out.copc.laz"])
def test_waveforms_are_refused_where_they_would_be_lost(form, name, tmp_path):
    scan = tmp_path / "scan.las"
    full_cloud(form).write(scan)

    line = refused(scan, tmp_path / name, *PATHS["whole"])

    assert f"points of format {form} refer to waveforms" in line


@pytest.mark.parametrize("chunk", [[], ["--chunk", 90]])
def test_generated_points_keep_the_header(chunk, folder, tmp_path):
    scan = tmp_path / "scan.las"
    out = tmp_path / "out.las"
    full_cloud(6).write(scan)

    done(scan, out, "--weights", folder, "--readout", "generated", "--m", 9, *chunk)

    header = laspy.read(out).header
    assert header.point_count == 9
    assert header.file_source_id == 77
    assert header.scales.tolist() == [0.01, 0.01, 0.001]


@pytest.mark.parametrize("budget", [["--spacing", 30], ["--voxel", 30]])
def test_points_of_a_spacing_and_of_voxels_keep_all_bytes(budget, tmp_path):
    scan = tmp_path / "scan.las"
    out = tmp_path / "out.las"
    full_cloud(6).write(scan)

    done(scan, out, *budget)

    number = len(laspy.read(out).points)
    assert 1 < number < 300
    check_copy(scan, out, number)


def test_points_without_attributes_have_one_return(tmp_path):
    scan = tmp_path / "scan.laz"
    out = tmp_path / "out.laz"
    full_cloud(6).write(scan)

    done(scan, out, *PATHS["whole"], "--coordinates-only")

    cloud = laspy.read(out)
    ones = np.ones(40)
    assert_array_equal(cloud.return_number, ones)
    assert_array_equal(cloud.number_of_returns, ones)
    assert_array_equal(cloud.intensity, np.zeros(40))
    assert cloud.header.file_source_id == 77
