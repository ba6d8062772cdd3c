import hashlib
import io
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from mops_lightning import filesystem
from mops_lightning.data.archive import unpack
from mops_lightning.errors import UserError


def write_zip(path: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members.items():
            packed.writestr(name, content)


def write_tar(path: Path, members: dict[str, bytes]) -> None:
    with tarfile.open(path, "w:gz") as packed:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            packed.addfile(info, io.BytesIO(content))


Write = Callable[[Path, dict[str, bytes]], None]
both = pytest.mark.parametrize("write", [write_zip, write_tar])


@both
@pytest.mark.parametrize("top", ["", "set/"])
@pytest.mark.parametrize("empty", [False, True])
def test_unpack_content_becomes_folder(tmp_path: Path, write: Write, top: str, empty: bool) -> None:
    write(tmp_path / "a", {f"{top}one.txt": b"1", f"{top}sub/two.txt": b"2" * 10**6})
    folder = tmp_path / "out"
    if empty:
        folder.mkdir()
    unpack(tmp_path / "a", folder)
    found = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*.txt")}
    assert found == {"one.txt": b"1", "sub/two.txt": b"2" * 10**6}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "out"]
    (tmp_path / "ordinary").mkdir()
    assert folder.stat().st_mode == (tmp_path / "ordinary").stat().st_mode


@both
def test_unpack_creates_empty_folders(tmp_path: Path, write: Write) -> None:
    if write is write_zip:
        write(tmp_path / "a", {"set/empty/": b"", "set/one.txt": b"1"})
    else:
        with tarfile.open(tmp_path / "a", "w:gz") as packed:
            info = tarfile.TarInfo("set/empty")
            info.type = tarfile.DIRTYPE
            packed.addfile(info)
            packed.addfile(tarfile.TarInfo("set/one.txt"))
    unpack(tmp_path / "a", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["empty", "one.txt"]


@both
@pytest.mark.parametrize("name", ["../out.txt", "a/../../out.txt", "/tmp/out.txt", r"C:\out.txt"])
def test_unpack_path_outside_folder_raises(tmp_path: Path, write: Write, name: str) -> None:
    write(tmp_path / "a", {"fine.txt": b"1", name: b"2"})
    with pytest.raises(UserError, match="outside the target folder"):
        unpack(tmp_path / "a", tmp_path / "sub" / "out")
    assert not any(path.is_file() for path in (tmp_path / "sub").rglob("*"))


def test_unpack_link_raises(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz") as packed:
        info = tarfile.TarInfo("link")
        info.type, info.linkname = tarfile.SYMTYPE, "/etc"
        packed.addfile(info)
    member = zipfile.ZipInfo("link")
    member.create_system, member.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as zipped:
        zipped.writestr(member, "/etc")
    for name in ("a.tar.gz", "a.zip"):
        with pytest.raises(UserError, match="neither a file nor a folder"):
            unpack(tmp_path / name, tmp_path / "out")


@both
@pytest.mark.parametrize("damage", ["cut", "flip", "noise", "empty"])
def test_unpack_damaged_archive_raises_and_cleans_up(
    tmp_path: Path, write: Write, damage: str
) -> None:
    archive = tmp_path / "a"
    write(archive, {f"{i}.txt": hashlib.sha512(bytes([i])).digest() * 5 for i in range(50)})
    data = bytearray(archive.read_bytes())
    if damage == "cut":
        del data[len(data) // 2 :]
    elif damage == "flip":
        data[200] ^= 0xFF
    else:
        data = bytearray(b"not an archive" if damage == "noise" else b"")
    archive.write_bytes(data)
    with pytest.raises(UserError, match=r"(is damaged|neither a zip nor a tar).* [Rr]emove it"):
        unpack(archive, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@both
def test_unpack_nonempty_folder_raises(tmp_path: Path, write: Write) -> None:
    write(tmp_path / "a", {"one.txt": b"1"})
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty"):
        unpack(tmp_path / "a", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_unpack_missing_archive_raises(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="Cannot unpack"):
        unpack(tmp_path / "none.zip", tmp_path / "out")


@both
@pytest.mark.parametrize("name", ["", ".", "./"])
def test_unpack_member_without_name_raises(tmp_path: Path, write: Write, name: str) -> None:
    if write is write_zip:
        with zipfile.ZipFile(tmp_path / "a", "w") as packed:
            packed.writestr("x", b"1")
            packed.infolist()[0].filename = name  # zipfile itself writes no empty name
    else:
        write(tmp_path / "a", {name: b"1"})
    with pytest.raises(UserError, match="a member without a name"):
        unpack(tmp_path / "a", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@both
def test_unpack_more_than_limit_raises(
    tmp_path: Path, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(filesystem, "MEMORY", 1000)
    write(tmp_path / "a", {"a.txt": bytes(3_000_000), "b.txt": bytes(10)})
    with pytest.raises(UserError, match="unpacks to more than"):
        unpack(tmp_path / "a", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_unpack_damaged_xz_raises(tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "a", "w:xz") as packed:
        info = tarfile.TarInfo("a.txt")
        info.size = 100_000
        packed.addfile(info, io.BytesIO(bytes(range(250)) * 400))
    content = bytearray((tmp_path / "a").read_bytes())
    content[-60:-40] = bytes(20)
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(UserError, match=r"is damaged|neither a zip nor a tar"):
        unpack(tmp_path / "a", tmp_path / "out")
