from pathlib import PurePath

import pytest
import torch
import trimesh

from mops_lightning.data.mesh_sequence import by_number, mesh_sequence
from mops_lightning.errors import UserError


@pytest.fixture
def folder(tmp_path):
    """Two sequences of boxes that grow with time; frame numbers are not padded."""
    for name, frames in (("crane", 12), ("samba", 10)):
        (tmp_path / name).mkdir()
        for frame in range(frames):
            box = trimesh.creation.box((1, 1, 1 + frame))
            box.export(tmp_path / name / f"mesh_{frame}.ply")
        (tmp_path / name / "notes.txt").write_text("no mesh")
    return tmp_path


def lengths(points):
    """Return the frame numbers from the proportions of the boxes."""
    size = points.amax(1) - points.amin(1)
    return (size[:, 2] / size[:, 0] - 1).round().int().tolist()


def test_mesh_sequence_splits_by_time_with_gap(folder):
    data = mesh_sequence(folder, n_points=3000, test_share=0.25, gap=2)
    assert data.class_names == ("crane", "samba")
    train, test = data.train, data.test
    crane, samba = (sorted(lengths(test.points[test.labels == label])) for label in (0, 1))
    assert crane == [9, 10, 11]
    assert samba == [8, 9]
    assert sorted(lengths(train.points[train.labels == 0])) == list(range(7))
    assert sorted(lengths(train.points[train.labels == 1])) == list(range(6))
    assert train.points.shape[1:] == (3000, 3)
    assert train.points.norm(dim=2).amax(1).allclose(torch.ones(13))


def test_mesh_sequence_spreads_test_frames_with_gaps(folder):
    data = mesh_sequence(folder, 3000, test_share=0.25, gap=1, test_frames="spread")
    train, test = data.train, data.test
    crane, samba = (sorted(lengths(test.points[test.labels == label])) for label in (0, 1))
    assert crane == [2, 6, 10]
    assert samba == [2, 7]
    assert sorted(lengths(train.points[train.labels == 0])) == [0, 4, 8]
    assert sorted(lengths(train.points[train.labels == 1])) == [0, 4, 5, 9]


def test_by_number_sorts_digits_that_are_no_numbers():
    names = ["f_10", "f_9", "1²", "²"]
    ordered = sorted((PurePath(f"{name}.ply") for name in names), key=by_number)
    assert [path.stem for path in ordered] == ["1²", "f_9", "f_10", "²"]


def test_mesh_sequence_class_and_cache(folder, tmp_path):
    cache = tmp_path / "cache"
    first = mesh_sequence(folder, 100, ["samba"], cache=cache)
    assert first.class_names == ("samba",)
    again = mesh_sequence(folder, 100, ["samba"], cache=cache)
    assert torch.equal(first.train.points, again.train.points)
    assert first.fingerprint == again.fingerprint


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"test_share": 0.0}, r"^test_share must be between 0 and 1, got 0.0"),
        ({"gap": -1}, r"^gap must be at least 0, got -1"),
        ({"gap": 10}, r"^gap must .*, got 10: .*crane has 12 frame.*2 of them.* at most 9, or"),
        ({"test_share": 0.99}, r"crane has 12 frame.*12 of them.* leave this sequence out"),
        ({"test_frames": "lats"}, r"^test_frames: unknown 'lats'.*last"),
        ({"gap": 5, "test_frames": "spread"}, r"^gap must .*, got 5.* at most 2, or"),
        ({"n_points": 0}, r"^n_points must be at least 1, got 0"),
        ({"classes": ["samb"]}, r"^classes: unknown class 'samb'.*samba"),
    ],
)
def test_mesh_sequence_invalid_argument_raises(folder, arguments, message):
    with pytest.raises(UserError, match=message):
        mesh_sequence(folder, **{"n_points": 50, **arguments})


def test_mesh_sequence_left_out_needs_no_training_frames(folder):
    (folder / "one").mkdir()
    trimesh.creation.box().export(folder / "one" / "mesh_0.ply")
    with pytest.raises(UserError, match=r"one has 1 frame.* leave this sequence out"):
        mesh_sequence(folder, 50)
    assert mesh_sequence(folder, 50, ["crane"]).class_names == ("crane",)


def test_mesh_sequence_empty_folder_raises(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"^root: no mesh in .* Looked for SEQUENCE"):
        mesh_sequence(tmp_path)


def test_mesh_sequence_real_data(real_data):
    root = real_data / "vlasic2008"
    if not root.is_dir():
        pytest.skip(f"{root} is not there")
    data = mesh_sequence(root, n_points=64)
    assert data.class_names == ("crane", "samba")
    assert len(data.test.labels) == 24
    assert len(data.train.labels) == 2 * (59 - 12 - 2)
