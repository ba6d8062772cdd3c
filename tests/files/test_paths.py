"""The output file of each input file."""

from pathlib import Path

import pytest

from mops_lightning.errors import UserError
from mops_lightning.files.batch import find_inputs
from mops_lightning.filesystem import TEMPORARY
from tests.support.downsample import refused


@pytest.fixture
def inputs(tmp_path, monkeypatch):
    """Clouds, a mesh and another file, in the working directory."""
    for name in ("in/a.npy", "in/deep/b.ply", "in/c.stl", "in/notes.md", "b.npy", "capital/D.NPY"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("source", "target", "expected"),
    [
        ("b.npy", "small.ply", ["small.ply"]),
        ("b.npy", "small.PLY", ["small.PLY"]),
        ("b.npy", "in", ["in/b.npy"]),
        ("capital", "out", ["out/D.npy"]),
        ("in", "out", ["out/a.npy", "out/c.ply", "out/deep/b.ply"]),
        ("in", "in/deep", ["in/deep/a.npy", "in/deep/c.ply"]),
        ("in/*.npy", "out", ["out/a.npy"]),
        ("in/[bc]*", "out", ["out/c.ply"]),
    ],
)
def test_outputs_follow_inputs(source, target, expected, inputs):
    found = find_inputs(Path(source), Path(target)).pairs
    assert [str(path) for _, path in found] == expected


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ("b.npy", "b.npy", "OUT must differ from IN"),
        ("b.npy", "b.npy/below.ply", "b.npy is a file, not a folder"),
        ("b.npy", "out.stl", "OUT must end in"),
        ("nowhere", "out", "nowhere: no such file or folder"),
        ("in", "b.npy", "OUT must be a folder"),
        ("empty", "out", "no file ends in"),
        ("in/*.las", "out", "no file ends in"),
        ("n*/b.npy", "out", "no such file or folder"),
        ("in", "out", "in/c.ply and in/c.stl have the same output out/c.ply"),
    ],
)
def test_impossible_output_is_rejected(source, target, message, inputs):
    Path("empty").mkdir()
    Path("in/c.ply").touch()
    with pytest.raises(UserError, match=message):
        find_inputs(Path(source), Path(target))


@pytest.mark.parametrize(
    ("source", "target"),
    [("loop", "out"), ("b.npy", "loop"), ("in", "loop"), ("loop/a.npy", "out"),
     ("a" * 300, "out"), ("b.npy", "a" * 300 + ".ply"), ("in", "a" * 300),
     ("in", "/proc/nowhere")],
)  # fmt: skip
def test_unusable_paths_end_in_one_line(source, target, inputs):
    Path("loop").symlink_to("loop")
    refused(source, target, "--method", "fps", "--m", 5)


def test_outputs_links_and_temporary_files_are_no_inputs(inputs):
    Path("in/loop.npy").symlink_to("loop.npy")
    Path("in/circle").symlink_to("../in")
    Path(f"in/{TEMPORARY}a-x.npy").touch()
    Path("in/.notes").touch()
    Path("in/.z.npy").touch()

    found = find_inputs(Path("in"), Path("out"))

    sources = [str(path) for path, _ in found.pairs]
    assert sources == ["in/.z.npy", "in/a.npy", "in/c.stl", "in/deep/b.ply"]
    assert found.unreadable == [Path("in/notes.md")]
