"""Which file is written for each input file."""

from pathlib import Path

import pytest

from mops_lightning.downsample_files.outputs import check_writable, jobs
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY


@pytest.fixture
def inputs(tmp_path, monkeypatch):
    """Clouds, a mesh and another file, in the working directory."""
    for name in ("in/a.npy", "in/deep/b.ply", "in/c.stl", "in/notes.md", "b.npy"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("source", "target", "file_format", "expected"),
    [
        ("b.npy", "small.ply", None, ["small.ply"]),
        ("b.npy", "in", None, ["in/b.npy"]),
        ("in", "out", None, ["out/a.npy", "out/c.ply", "out/deep/b.ply"]),
        ("in", "out", "LAS", ["out/a.las", "out/c.las", "out/deep/b.las"]),
        ("in", "in/deep", None, ["in/deep/a.npy", "in/deep/c.ply"]),
    ],
)
def test_outputs_follow_inputs(source, target, file_format, expected, inputs):
    found = jobs(Path(source), Path(target), file_format, False)
    assert [str(path) for _, path in found] == expected


@pytest.mark.parametrize(
    ("source", "target", "file_format", "message"),
    [
        ("b.npy", "b.npy", None, "OUT must differ from IN"),
        ("b.npy", "b.npy/below.ply", None, "b.npy is a file, not a folder"),
        ("b.npy", "out.stl", None, "OUT must end in"),
        ("b.npy", "out.obj", None, ".obj holds coordinates only"),
        ("b.npy", "out", "stl", "--format must be one of .* got stl"),
        ("nowhere", "out", None, "nowhere: no such file or folder"),
        ("in", "b.npy", None, "OUT must be a folder"),
        ("empty", "out", None, "empty contains no file"),
        ("in", "out", "ply", "a.npy and in/a.ply have the same output out/a.ply"),
    ],
)
def test_impossible_output_is_rejected(source, target, file_format, message, inputs):
    Path("empty").mkdir()
    Path("in/a.ply").touch()
    with pytest.raises(UserError, match=message):
        jobs(Path(source), Path(target), file_format, True)


@pytest.mark.parametrize(
    ("source", "target"),
    [("loop", "out"), ("b.npy", "loop"), ("in", "loop"), ("loop/a.npy", "out"),
     ("a" * 300, "out"), ("b.npy", "a" * 300 + ".ply"), ("in", "a" * 300)],
)  # fmt: skip
def test_outputs_loop_or_long_name_raises(source, target, inputs):
    Path("loop").symlink_to("loop")
    with pytest.raises(UserError, match=r"IN or OUT|no such file|cannot be"):
        jobs(Path(source), Path(target), None, False)


def test_outputs_links_and_temporary_files_are_no_inputs(inputs):
    Path("in/loop.npy").symlink_to("loop.npy")
    Path("in/circle").symlink_to("../in")
    Path(f"in/{TEMPORARY}a-x.npy").touch()
    found = jobs(Path("in"), Path("out"), None, False)
    assert [str(path) for path, _ in found] == ["in/a.npy", "in/c.stl", "in/deep/b.ply"]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that is never writable")
def test_check_writable_read_only_folder_raises():
    with pytest.raises(UserError, match=r"OUT: cannot write into /proc/nowhere"):
        check_writable(Path("/proc/nowhere"))
