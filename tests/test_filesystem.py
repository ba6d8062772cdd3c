import os
import zipfile

import numpy as np
import pytest

from mops_lightning import filesystem
from mops_lightning.errors import UserError, file_error
from mops_lightning.filesystem import atomic_write, is_temporary, load_npz, remove_temporary
from tests.support.full_disk import full_disk


def test_atomic_write_replaces_the_old_file(tmp_path):
    path = tmp_path / "folder" / "file.txt"
    for text in ("old", "new"):
        with atomic_write(path) as temporary:
            assert temporary.suffix == ".txt"
            temporary.write_text(text)
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_atomic_write_makes_files_that_others_read_as_the_user_lets_them(mask, mode, tmp_path):
    path = tmp_path / "file.txt"
    before = os.umask(mask)

    try:
        with atomic_write(path) as temporary:
            temporary.write_text("text")
    finally:
        os.umask(before)

    assert path.stat().st_mode & 0o777 == mode


def test_atomic_write_after_an_error_keeps_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")

    def break_off():
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_remove_temporary_removes_what_a_kill_left(tmp_path):
    path = tmp_path / "below" / f"{'n' * 240}.txt"
    with atomic_write(path) as temporary:
        temporary.write_text("half")
        left = temporary.with_name(f"{temporary.name}2").write_bytes(b"as after a kill")
        assert is_temporary(temporary)
    assert left
    assert len(list(path.parent.iterdir())) == 2
    remove_temporary(tmp_path)
    assert list(path.parent.iterdir()) == [path]
    assert not is_temporary(path)


def test_remove_temporary_keeps_what_is_being_written(tmp_path):
    path = tmp_path / "file.txt"
    with atomic_write(path) as temporary:
        temporary.write_text("text")
        remove_temporary(tmp_path)
    assert path.read_text() == "text"
    remove_temporary(path / "below")  # no folder


def test_load_npz_small_file_of_large_arrays_is_refused(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", points=np.zeros((10**6, 3)))
    assert load_npz(tmp_path / "a.npz")["points"].shape == (10**6, 3)
    monkeypatch.setattr(filesystem, "MEMORY", 1000)
    with pytest.raises(UserError, match=r"a\.npz is broken: .* bytes announced"):
        load_npz(tmp_path / "a.npz")


def test_atomic_write_keeps_a_pipe_and_a_link_to_a_device(tmp_path):
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "null.ply").symlink_to("/dev/null")
    for path in (tmp_path / "pipe.ply", tmp_path / "null.ply"):
        with pytest.raises(OSError, match="not a file") as error, atomic_write(path):
            pass
        assert file_error(error.value) == f"{path}: is a folder, a pipe or a device, not a file."
        assert not path.is_file()
    assert len(list(tmp_path.iterdir())) == 2


def test_load_npz_of_a_pipe_or_of_no_arrays_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    np.savez(tmp_path / "objects.npz", points=np.array([{}], object))
    with zipfile.ZipFile(tmp_path / "text.npz", "w") as packed:
        packed.writestr("points.npy", b"no array")
    for name, said in (
        ("pipe", r"pipe\.npz is broken: FileNotFoundError"),
        ("objects", r"objects\.npz is broken"),
        ("text", "points is not an array"),
    ):
        with pytest.raises(UserError, match=said):
            load_npz(tmp_path / f"{name}.npz")


def test_atomic_write_on_full_disk_names_the_file(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with (
        full_disk(1000),
        pytest.raises(OSError, match="too large") as error,
        atomic_write(path) as temporary,
    ):
        temporary.write_bytes(b"x" * 2000)
    assert file_error(error.value).startswith(f"{path}: File too large. Free some space")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
