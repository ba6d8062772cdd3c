"""Where the subcommand ``propagate`` writes, and samples that are unusual."""

import numpy as np
import pytest

from mops_lightning.files.cli import propagate as main
from mops_lightning.filesystem import TEMPORARY
from tests.support.captured import done, refused
from tests.support.cloud_files import contents, write_cloud
from tests.support.clouds import line_of, uniform_points
from tests.support.downsample import done as downsample

FIELD = ["--field", "label"]


@pytest.fixture
def line_files(tmp_path):
    """Five points on a line, and a sample of three with a label."""
    small = tmp_path / "small.npz"
    big = tmp_path / "big.npz"
    line = line_of(5)
    write_cloud(big, line)
    write_cloud(small, line[[0, 2, 4]], {"label": np.array([5, 9, 9])})
    return [small, big]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("big.LAZ", "big_propagated.LAZ"),
        ("big.las", "big_propagated.las"),
        ("big.copc.laz", "big_propagated.laz"),
        ("big.npz", "big_propagated.ply"),
    ],
)
def test_result_is_beside_the_cloud_in_its_format_if_that_can_be_written(name, expected, tmp_path):
    small = tmp_path / "small.npz"
    big = tmp_path / name
    points = uniform_points(50, 1)
    write_cloud(tmp_path / f"written{big.suffix.lower()}", points)
    (tmp_path / f"written{big.suffix.lower()}").rename(big)
    write_cloud(small, points[:3], {"label": np.arange(3)})

    done(main, [small, big, *FIELD])

    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, expected, "small.npz"])
    assert len(contents(tmp_path / expected).points) == 50


def test_sample_is_not_replaced_by_the_result(line_files):
    small, big = line_files
    sample = small.with_suffix(".ply")
    write_cloud(sample, line_of(3), {"label": np.arange(3)})
    before = sample.read_bytes()

    said = refused(main, [sample, big, sample, *FIELD, "--overwrite"])

    assert "OUT must differ from SMALL and BIG" in said
    assert sample.read_bytes() == before


def test_what_a_killed_run_left_beside_the_result_is_removed(line_files, tmp_path):
    left = tmp_path / f"{TEMPORARY}out-x.ply"
    left.write_bytes(b"half")

    done(main, [*line_files, tmp_path / "out.ply", *FIELD])

    assert not left.exists()


@pytest.mark.parametrize("kind", [np.uint64, np.float64, np.uint16])
def test_packed_colours_of_other_sizes_are_not_averaged(kind, line_files, tmp_path):
    _, big = line_files
    small = tmp_path / "packed.npz"
    write_cloud(small, line_of(3), {"rgb": np.arange(3).astype(kind)})

    said = refused(main, [small, big, tmp_path / "out.ply", "--field", "rgb", "--k", 2, "--mean"])

    kind_of_message = np.dtype(kind)
    assert "--field rgb: only packed colours of 32 bits can be averaged" in said
    assert f"got {kind_of_message}" in said


def test_points_of_the_sample_without_coordinates_are_not_near(line_files, tmp_path):
    _, big = line_files
    small = tmp_path / "holes.npz"
    out = tmp_path / "out.ply"
    points = line_of(3)
    points[1] = np.nan
    np.savez(small, points=points, label=np.array([5, 6, 7]))

    done(main, [small, big, out, *FIELD])

    assert set(contents(out).columns["label"].tolist()) == {5, 7}


def test_map_holds_the_number_of_kept_points(tmp_path):
    source = tmp_path / "in.npy"
    map_ = tmp_path / "map.npz"
    np.save(source, uniform_points(500, 1))

    downsample(source, tmp_path / "small.ply", "--m", 30, "--method", "fps", "--map", map_)

    arrays = np.load(map_)
    assert int(arrays["m"]) == 30
    assert arrays["rows"].shape == (500, 1)
    assert arrays["rows"].dtype == np.int32
    assert set(arrays.files) == {"rows", "m"}
