"""Which files of a folder are trained on and which are tested."""

from pathlib import PurePosixPath

import pytest

from mops_lightning.data.file_splits import (
    by_number,
    class_of,
    list_files,
    split_by_folder,
    split_by_share,
    split_by_time,
)
from mops_lightning.errors import UserError


def paths(*names):
    return [PurePosixPath(name) for name in names]


def numbered(folder, number):
    """Return the paths of numbered files in a folder."""
    return [PurePosixPath(folder, f"{i}.ply") for i in range(number)]


def names_in(files, split):
    return [str(file.name) for file in files if file.split == split]


def test_split_by_folder_first_or_second_folder():
    names = paths("train/a.ply", "chair/test/b.ply", "train/chair/deep/c.ply")

    files = split_by_folder(names)

    assert files is not None
    assert [file.split for file in files] == ["train", "test", "train"]
    assert [file.class_name for file in files] == ["cloud", "chair", "chair"]


def test_split_by_folder_looks_at_two_folders_only():
    deep = paths("scans/monday/train/a.ply", "scans/monday/test/b.ply")

    assert split_by_folder(deep) is None
    assert class_of(PurePosixPath("train/test/chair/a.ply")) == "cloud"


def test_list_files_leaves_out_hidden_files_and_folders_and_other_kinds(tmp_path):
    for name in ("a.PLY", "b/c.ply", ".hidden.ply", ".git/d.ply", "b/.e/f.ply", "notes.txt"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (tmp_path / "folder.ply").mkdir()

    assert list_files(tmp_path, (".ply",)) == paths("a.PLY", "b/c.ply")


def test_split_by_folder_without_folders_of_splits_is_none():
    assert split_by_folder(paths("a.ply", "chair/b.ply")) is None


def test_split_by_folder_file_outside_raises():
    with pytest.raises(UserError, match=r"chair/b\.ply is neither in train/ nor in test/"):
        split_by_folder(paths("train/a.ply", "chair/b.ply"))


def test_split_by_share_depends_on_the_seed():
    names = numbered("a", 10)

    first = split_by_share(names, 0.3, seed=0)
    again = split_by_share(names, 0.3, seed=0)
    other = split_by_share(names, 0.3, seed=1)

    assert first == again
    assert first != other
    assert len(names_in(first, "test")) == 3


def test_split_by_share_rounds_and_draws_for_every_class_anew():
    names = [*numbered("a", 18), *numbered("b", 18)]

    tested = names_in(split_by_share(names, 0.2, seed=0), "test")

    of_a = [name.removeprefix("a/") for name in tested if name.startswith("a/")]
    of_b = [name.removeprefix("b/") for name in tested if name.startswith("b/")]
    assert len(of_a) == 4  # 3.6 files
    assert len(of_b) == 4
    assert of_a != of_b


def test_split_by_time_rounds_and_tests_one_frame_at_least():
    names = [*numbered("long", 18), *numbered("short", 3)]

    files = split_by_time(names, 0.1, gap=0)

    assert names_in(files, "test") == ["long/16.ply", "long/17.ply", "short/2.ply"]
    assert len(names_in(files, "train")) == 18


def test_split_by_time_sorts_folders_of_a_sequence_before_their_frames():
    names = paths("walk/a/8.ply", "walk/a/9.ply", "walk/b/1.ply", "walk/b/2.ply")

    files = split_by_time(names, 0.5, gap=0)

    assert names_in(files, "test") == ["walk/b/1.ply", "walk/b/2.ply"]


def test_split_by_time_gap_may_leave_one_training_frame():
    names = numbered("crane", 12)

    files = split_by_time(names, 0.2, gap=9)

    assert names_in(files, "train") == ["crane/0.ply"]
    assert names_in(files, "test") == ["crane/10.ply", "crane/11.ply"]


def test_by_number_sorts_digits_that_are_no_numbers():
    names = paths("f_10.ply", "f_9.ply", "1².ply", "².ply")

    ordered = sorted(names, key=by_number)

    assert [path.stem for path in ordered] == ["1²", "f_9", "f_10", "²"]


FRAMES = [*numbered("crane", 12), *numbered("samba", 10)]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0.2, 10), r"^gap must .*, got 10: crane has 12 frame.*2 of them.* below 10, or"),
        ((0.99, 2), r"crane has 12 frame.*12 of them.* smaller test_share"),
    ],
)
def test_split_by_time_invalid_argument_raises(settings, message):
    with pytest.raises(UserError, match=message):
        split_by_time(FRAMES, *settings)
