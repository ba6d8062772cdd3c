"""Which files of a folder are trained on and which are tested."""

from pathlib import PurePosixPath

import pytest

from mops_lightning.data.file_splits import (
    by_number,
    split_by_folder,
    split_by_share,
    split_by_time,
)
from mops_lightning.errors import UserError


def paths(*names):
    return [PurePosixPath(name) for name in names]


def test_split_by_folder_first_or_second_folder():
    names = paths("train/a.ply", "chair/test/b.ply", "train/chair/deep/c.ply")

    files = split_by_folder(names)

    assert files is not None
    assert [file.split for file in files] == ["train", "test", "train"]
    assert [file.class_name for file in files] == ["cloud", "chair", "chair"]


def test_split_by_folder_without_folders_of_splits_is_none():
    assert split_by_folder(paths("a.ply", "chair/b.ply")) is None


def test_split_by_folder_file_outside_raises():
    with pytest.raises(UserError, match=r"chair/b\.ply is neither in train/ nor in test/"):
        split_by_folder(paths("train/a.ply", "chair/b.ply"))


def test_split_by_share_depends_on_the_seed():
    names = paths(*(f"a/{i}.ply" for i in range(10)))

    first = split_by_share(names, 0.3, seed=0)
    again = split_by_share(names, 0.3, seed=0)
    other = split_by_share(names, 0.3, seed=1)

    assert first == again
    assert first != other
    assert [file.split for file in first].count("test") == 3


def test_by_number_sorts_digits_that_are_no_numbers():
    names = paths("f_10.ply", "f_9.ply", "1².ply", "².ply")

    ordered = sorted(names, key=by_number)

    assert [path.stem for path in ordered] == ["1²", "f_9", "f_10", "²"]


FRAMES = paths(*(f"crane/{i}.ply" for i in range(12)), *(f"samba/{i}.ply" for i in range(10)))


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
