from pathlib import PurePath, PurePosixPath

import pytest

from mops_lightning.data.cloud_folder import (
    by_number,
    class_of,
    split_by_folder,
    split_by_share,
    split_by_time,
)
from mops_lightning.errors import UserError


def paths(*names):
    return [PurePosixPath(name) for name in names]


def test_split_by_folder_first_or_second_folder():
    names = paths("train/a.ply", "chair/test/b.ply", "train/chair/deep/c.ply")
    assert split_by_folder(names) == ["train", "test", "train"]
    assert [class_of(name) for name in names] == ["cloud", "chair", "chair"]
    assert split_by_folder(paths("a.ply", "chair/b.ply")) is None
    with pytest.raises(UserError, match=r"chair/b\.ply is neither in train/ nor in test/"):
        split_by_folder(paths("train/a.ply", "chair/b.ply"))


def test_split_by_share_depends_on_the_seed():
    names = paths(*(f"a/{i}.ply" for i in range(10)))
    first, again, other = (split_by_share(names, 0.3, seed) for seed in (0, 0, 1))
    assert first == again != other


def test_by_number_sorts_digits_that_are_no_numbers():
    names = ["f_10", "f_9", "1²", "²"]
    ordered = sorted((PurePath(f"{name}.ply") for name in names), key=by_number)
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
