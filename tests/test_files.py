import pytest

from mops_lightning.errors import did_you_mean
from mops_lightning.files import atomic_write


def test_a_whole_file_takes_the_place_of_the_old_one(tmp_path):
    path = tmp_path / "folder" / "file.txt"
    for text in ("old", "new"):
        with atomic_write(path) as temporary:
            assert temporary.suffix == ".txt"
            temporary.write_text(text)
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]
    assert path.stat().st_mode & 0o444


def test_after_an_error_the_old_file_stands_and_nothing_else(tmp_path):
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


def test_the_nearest_names_are_offered():
    assert did_you_mean("chiar", ["chair", "table"]) == (
        " Did you mean 'chair'? Allowed: chair, table."
    )
    assert did_you_mean("zzz", ["chair"]) == " Allowed: chair."
