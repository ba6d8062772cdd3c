"""Weights of points by a column of the file."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mops_lightning.data.formats.table import Table
from mops_lightning.files.column_weights import weights_of
from tests.support.cloud_files import contents
from tests.support.clouds import normal_points
from tests.support.downsample import done, refused

SPLAT = [
    *("x", "y", "z"),
    *("nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]
"""The properties that the reference implementation of 3D Gaussian splatting writes."""

OPACITY = SPLAT.index("opacity")


@pytest.fixture(scope="module")
def splat(tmp_path_factory):
    """A splat file with the header of the reference implementation; half of it is transparent."""
    path = tmp_path_factory.mktemp("splat") / "point_cloud.ply"
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(400, len(SPLAT))).astype("<f4")
    rows[:, OPACITY] = np.tile([-6, 6], 200)
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 400"]
    for name in SPLAT:
        lines.append(f"property float {name}")
    lines.append("end_header\n")
    head = "\n".join(lines)
    path.write_bytes(head.encode() + rows.tobytes())
    return path, rows


def head_and_data(path):
    head, data = path.read_bytes().split(b"end_header\n", 1)
    return head, data


def bytes_of_rows(rows):
    return {row.tobytes() for row in rows}


@pytest.mark.parametrize("method", ["fps", "poisson", "random"])
def test_splat_is_pruned_by_opacity_with_all_properties(method, splat, tmp_path):
    path, rows = splat
    small = tmp_path / "small.ply"

    done(path, small, "--method", method, "--m", 150, "--weight", "opacity")

    source_head, _ = head_and_data(path)
    head, data = head_and_data(small)
    assert head == source_head.replace(b"vertex 400", b"vertex 150")
    kept = np.frombuffer(data, "<f4").reshape(150, len(SPLAT))
    different = bytes_of_rows(kept)
    assert len(different) == 150
    assert different <= bytes_of_rows(rows)
    opacity = kept[:, OPACITY]
    assert (opacity > 0).mean() > 0.9


def test_splat_keeps_transparent_points_where_there_is_room(splat, tmp_path):
    path, _ = splat  # 200 of its 400 points have a logit below 0
    small = tmp_path / "small.ply"

    done(path, small, "--method", "fps", "--m", 350, "--weight", "opacity")

    kept = contents(small).columns["opacity"]
    assert np.count_nonzero(kept < 0) == 150
    assert np.count_nonzero(kept > 0) == 200


@pytest.mark.parametrize("logit", [-6.0, 0.0, 6.0])
def test_weight_of_a_splat_is_its_opacity(logit, splat):
    path, _ = splat
    logits = np.full(400, logit, np.float32)
    table = contents(path).with_columns({"opacity": logits})

    weight = weights_of(table, "opacity", path)

    expected = 1 / (1 + np.exp(-logit))
    assert weight == pytest.approx(expected)


def test_weight_of_a_column_named_opacity_outside_of_a_splat_is_its_number():
    numbers = np.array([0.0, 0.25, 2.0])
    table = Table(np.eye(3), {"opacity": numbers})

    weight = weights_of(table, "opacity", Path("scan.ply"))

    assert weight.tolist() == [0.0, 0.25, 2.0]


def test_completed_set_is_filled_up_by_weight(folder, tmp_path):
    source = tmp_path / "a.npz"
    out = tmp_path / "b.npz"
    # Without the weights, all matches would be the points near the origin.
    points = normal_points(300, 0)
    points[::2] *= 0.01
    score = np.arange(300) % 2
    np.savez(source, points=points, score=score)

    done(source, out, "--weights", folder, "--m", 40, "--weight", "score")

    score = contents(out).columns["score"]
    assert score.tolist() == [1] * 40


def test_weight_acts_among_the_points_of_a_chunk(splat, tmp_path):
    path, _ = splat
    out = tmp_path / "a.ply"
    settings = ["--method", "fps", "--m", 90, "--weight", "opacity", "--chunk", 250]

    done(path, out, *settings)

    table = contents(out)
    assert len(table.points) == 90
    is_opaque = table.columns["opacity"] > 0
    assert is_opaque.mean() > 0.9


@pytest.mark.parametrize(
    ("field", "arguments", "said"),
    [
        ("labl", ["--method", "fps"], "has no column 'labl'. Did you mean 'label'?"),
        ("low", ["--method", "fps"], "must be finite and at least 0, got -1.0 in row 0"),
        ("hole", ["--method", "fps"], "must be finite and at least 0, got nan in row 2"),
        ("", ["--method", "fps"], "no column ''. Allowed: curvature, few, hole, label, low."),
        ("few", ["--method", "fps"], "4 points have a weight above 0, fewer than m=5"),
        ("label", ["--method", "voxel"], "--weight: VoxelSampler takes no weights. Use fps"),
        ("label", ["--weights", "MODEL", "--readout", "matched"], "matched readout takes no"),
        ("label", ["--method", "fps", "--tile", 9], "leave --tile out"),
    ],
)
def test_weight_that_cannot_be_used_ends_in_one_line(field, arguments, said, folder, tmp_path):
    source = tmp_path / "a.npz"
    out = tmp_path / "b.npz"
    label = np.arange(50.0)
    columns: dict[str, Any] = {
        "points": np.eye(50)[:, :3],
        "label": label,
        "low": label - 1,
        "few": np.where(label < 5, label, 0),
        "hole": np.where(label == 2, np.nan, label),
        "curvature": label,
    }
    np.savez(source, **columns)
    arguments = [folder if argument == "MODEL" else argument for argument in arguments]

    line = refused(source, out, "--m", 5, "--weight", field, *arguments)

    assert said in line


def test_weight_of_a_chunk_is_no_column_of_coordinates_alone(splat, tmp_path):
    path, _ = splat
    out = tmp_path / "b.ply"
    settings = ["--method", "fps", "--m", 90, "--weight", "opacity", "--chunk", 250]

    done(path, out, *settings, "--coordinates-only")

    assert not contents(out).columns


@pytest.fixture
def plane_and_sphere():
    """500 points of a plane, and 500 of a small sphere above it."""
    plane = normal_points(500, 0) * [3, 3, 0]
    directions = normal_points(500, 1)
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    sphere = 0.3 * directions / lengths + [0, 0, 9]
    return np.vstack([plane, sphere])


BY_CURVATURE = ["--method", "random", "--m", 200, "--weight", "curvature"]


def test_curvature_is_computed(plane_and_sphere, tmp_path):
    source = tmp_path / "a.npy"
    out = tmp_path / "b.npy"
    np.save(source, plane_and_sphere)

    done(source, out, *BY_CURVATURE)

    height = np.load(out)[:, 2]
    of_sphere = height > 5
    assert of_sphere.mean() > 0.6


def test_curvature_is_a_column_of_the_file_if_it_has_one(plane_and_sphere, tmp_path):
    source = tmp_path / "a.npz"
    out = tmp_path / "c.npy"
    of_plane = np.repeat([1, 0], 500)
    np.savez(source, points=plane_and_sphere, curvature=of_plane)

    done(source, out, *BY_CURVATURE)

    height = np.load(out)[:, 2]
    assert (height < 5).all()
