"""Weights of points by a column of the file."""

import numpy as np
import pytest

from mops_lightning.data.formats.registry import read
from mops_lightning.files.column_weights import weights_of
from tests.support.downsample import call, done

SPLAT = [
    "x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)), "opacity", *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]  # fmt: skip
"""The properties that the reference implementation of 3D Gaussian splatting writes."""


@pytest.fixture(scope="module")
def splat(tmp_path_factory):
    """A splat file with the header of the reference implementation; half of it is transparent."""
    path = tmp_path_factory.mktemp("splat") / "point_cloud.ply"
    rows = np.random.default_rng(0).normal(size=(400, len(SPLAT))).astype("<f4")
    rows[:, SPLAT.index("opacity")] = np.tile([-6, 6], 200)
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [*(f"property float {name}" for name in SPLAT), "end_header", ""]
    path.write_bytes("\n".join(lines).encode() + rows.tobytes())
    return path, rows


@pytest.mark.parametrize("method", ["fps", "poisson", "random"])
def test_splat_is_pruned_by_opacity_with_all_properties(method, splat, tmp_path):
    path, rows = splat
    settings = ["--method", method, "--m", 150, "--weight", "opacity"]
    done(path, tmp_path / "small.ply", *settings)
    content = (tmp_path / "small.ply").read_bytes()
    header, data = content.split(b"end_header\n", 1)
    source = path.read_bytes().split(b"end_header\n", 1)[0]
    assert header == source.replace(b"vertex 400", b"vertex 150")
    kept = np.frombuffer(data, "<f4").reshape(150, len(SPLAT))
    assert len(kept) == len({row.tobytes() for row in kept})
    assert {row.tobytes() for row in kept} <= {row.tobytes() for row in rows}
    assert (kept[:, SPLAT.index("opacity")] > 0).mean() > 0.9


def test_splat_keeps_transparent_points_where_there_is_room(splat, tmp_path):
    path, rows = splat  # 200 of its 400 points have a logit below 0

    done(path, tmp_path / "small.ply", "--method", "fps", "--m", 350, "--weight", "opacity")

    kept = read(tmp_path / "small.ply", 9, 0).columns["opacity"]
    assert np.unique(kept, return_counts=True)[1].tolist() == [150, 200]


@pytest.mark.parametrize("logit", [-6.0, 0.0, 6.0])
def test_weight_of_a_splat_is_its_opacity(logit, splat):
    path, _ = splat
    table = read(path, 9, 0).with_columns({"opacity": np.full(400, logit, np.float32)})

    weight = weights_of(table, "opacity", path)

    assert weight == pytest.approx(1 / (1 + np.exp(-logit)))


def test_completed_set_is_filled_up_by_weight(folder, tmp_path):
    np.savez(
        tmp_path / "a.npz",
        # Without the weights, all matches would be the points near the origin.
        points=(np.random.default_rng(0).normal(size=(150, 2, 3)) * [[0.01], [1]]).reshape(-1, 3),
        score=np.arange(300) % 2,
    )
    settings = ["--weights", folder, "--m", 40, "--weight", "score"]
    assert call(tmp_path / "a.npz", tmp_path / "b.npz", *settings)[0] == 0
    assert read(tmp_path / "b.npz", 9, 0).columns["score"].tolist() == [1] * 40


def test_weight_acts_among_the_points_of_a_chunk(splat, tmp_path):
    settings = ["--method", "fps", "--m", 90, "--weight", "opacity", "--chunk", 250]
    assert call(splat[0], tmp_path / "a.ply", *settings)[0] == 0
    table = read(tmp_path / "a.ply", 9, 0)
    assert len(table.points) == 90
    assert (table.columns["opacity"] > 0).mean() > 0.9
    assert call(splat[0], tmp_path / "b.ply", *settings, "--coordinates-only")[0] == 0
    assert not read(tmp_path / "b.ply", 9, 0).columns


def test_curvature_is_computed_unless_it_is_a_column(tmp_path):
    plane, sphere = np.random.default_rng(0).normal(size=(2, 500, 3))
    plane *= [3, 3, 0]
    sphere = sphere / np.linalg.norm(sphere, axis=1, keepdims=True) * 0.3 + [0, 0, 9]
    points, settings = np.vstack([plane, sphere]), ["--method", "random", "--m", 200]
    np.save(tmp_path / "a.npy", points)
    assert call(tmp_path / "a.npy", tmp_path / "b.npy", *settings, "--weight", "curvature")[0] == 0
    assert (np.load(tmp_path / "b.npy")[:, 2] > 5).mean() > 0.6
    np.savez(tmp_path / "a.npz", points=points, curvature=np.repeat([1, 0], 500))
    assert call(tmp_path / "a.npz", tmp_path / "c.npy", *settings, "--weight", "curvature")[0] == 0
    assert (np.load(tmp_path / "c.npy")[:, 2] < 5).all()


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
    label = np.arange(50.0)
    columns = {"label": label, "low": label - 1, "few": label * (label < 5), "curvature": label}
    hole = np.where(label == 2, np.nan, label)
    np.savez(tmp_path / "a.npz", allow_pickle=False, points=np.eye(50)[:, :3], hole=hole, **columns)
    arguments = [folder if argument == "MODEL" else argument for argument in arguments]
    settings = ["--m", 5, "--weight", field, *arguments]
    status, _, err = call(tmp_path / "a.npz", tmp_path / "b.npz", *settings)
    assert status == 2
    assert said in err
    assert len(err.strip().splitlines()) == 1
