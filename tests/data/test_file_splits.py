from pathlib import PurePath, PurePosixPath

import numpy as np
import pytest

from mops_lightning.data.file_splits import (
    by_number,
    class_of,
    neighbouring_tiles,
    read_split_list,
    split_by_folder,
    split_by_share,
    split_by_time,
)
from mops_lightning.errors import UserError


def paths(*names):
    return [PurePosixPath(name) for name in names]


def box(x, y, side=10.0, height=3.0):
    return np.array([[x, y, 0], [x + side, y + side, height]])


STREET = [box(10 * i + 400_000, 5_000_000) for i in range(10)]


def test_split_by_folder_first_or_second_folder():
    names = paths("train/a.ply", "chair/test/b.ply", "train/chair/deep/c.ply")
    assert split_by_folder(names) == ["train", "test", "train"]
    assert [class_of(name) for name in names] == ["cloud", "chair", "chair"]
    assert split_by_folder(paths("a.ply", "chair/b.ply")) is None


def test_split_by_folder_file_outside_raises():
    with pytest.raises(UserError, match=r"chair/b\.ply is neither in train/ nor in test/"):
        split_by_folder(paths("train/a.ply", "chair/b.ply"))


def test_neighbouring_tiles_touch():
    grid = [box(x, y) for x in (0, 10) for y in (0, 10, 20)]
    assert neighbouring_tiles(grid)[0] == [1, 3, 4]
    assert neighbouring_tiles([box(0, 0, height=0), box(10.1, 0, height=0)]) == [[1], [0]]
    assert neighbouring_tiles([box(0, 0), box(11, 0), box(100, 0)]) == [[], [], []]


def test_neighbouring_tiles_overlapping_scans_have_none():
    walk = [box(3.0 * i, 0) for i in range(6)]  # frames of a person that walks
    assert neighbouring_tiles(walk) == [[]] * 6
    assert neighbouring_tiles([box(0, 0, side=0.0, height=0.0)] * 2) == [[], []]


@pytest.mark.parametrize("seed", range(5))
def test_split_by_share_test_tiles_touch_no_training_tile(seed):
    names = paths(*(f"tile_{i}.las" for i in range(10)))
    splits = split_by_share(names, STREET, 0.2, seed)
    tests = [i for i, split in enumerate(splits) if split == "test"]
    assert len(tests) == 2
    assert tests[1] == tests[0] + 1
    left_out = {i for i, split in enumerate(splits) if not split}
    assert left_out == {i for i in (tests[0] - 1, tests[1] + 1) if 0 <= i < 10}


def test_split_by_share_every_class_and_seed():
    names = paths(*(f"{one}/{i}.ply" for one in ("a", "b") for i in range(10)), "c/alone.ply")
    boxes = [box(0, 0)] * len(names)
    splits = split_by_share(names, boxes, 0.3, 0)
    tests = [name for name, split in zip(names, splits, strict=True) if split == "test"]
    assert [name.parts[0] for name in tests] == ["a"] * 3 + ["b"] * 3
    assert splits == split_by_share(names, boxes, 0.3, 0)
    assert splits != split_by_share(names, boxes, 0.3, 1)


def test_split_by_share_no_training_file_left_raises():
    with pytest.raises(UserError, match=r"no train file.*1 of them touch.*split_file"):
        split_by_share(paths("a.las", "b.las"), STREET[:2], 0.5, 0)
    with pytest.raises(UserError, match="no test file is left of 1"):
        split_by_share(paths("a.las"), STREET[:1], 0.5, 0)


@pytest.fixture
def flat(tmp_path):
    for name in ("box/1.off", "box/2.off", "ball/old, round/3.off", "ball/4.off", "5.off"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    return tmp_path


def test_read_split_list_gives_split_of_paths(flat):
    lines = [
        "path,split",
        "# a comment",
        "",
        "box/1.off,train",
        '"ball/old, round/3.off", train',
        " box/2.off , test ",
        "5.off,test",
    ]
    (flat / "split.csv").write_text("\ufeff" + "\n".join(lines), encoding="utf-8")
    expected = {
        PurePosixPath("box/1.off"): "train",
        PurePosixPath("ball/old, round/3.off"): "train",
        PurePosixPath("box/2.off"): "test",
        PurePosixPath("5.off"): "test",
    }
    for path in (PurePath("split.csv"), flat / "split.csv"):
        assert read_split_list(flat, flat / path, (".off",)) == expected


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("box/2.off", "line 2: must read 'path,train' or 'path,test'"),
        ("box/2.off,val", "line 2: must read"),
        ("/box/2.off,train", "line 2: the path must be relative to"),
        ("box/../box/2.off,train", "line 2: the path must be relative to"),
        ("box/2.txt,train", "line 2: box/2.txt must end in"),
        ("box/1.off,test", "line 2: box/1.off is listed twice"),
        ("box/9.off,test", "line 2: .*9.off does not exist"),
    ],
)
def test_read_split_list_invalid_line_raises(flat, line, message):
    (flat / "split.txt").write_text(f"box/1.off,train\n{line}\n")
    with pytest.raises(UserError, match=rf"^split_file: .*split\.txt, {message}"):
        read_split_list(flat, flat / "split.txt", (".off",))


def test_read_split_list_without_content_raises(flat):
    with pytest.raises(UserError, match=r"^split_file: cannot read .*none\.txt"):
        read_split_list(flat, flat / "none.txt", (".off",))
    (flat / "split.txt").write_text("# nothing\n")
    with pytest.raises(UserError, match="lists no file"):
        read_split_list(flat, flat / "split.txt", (".off",))


def test_by_number_sorts_digits_that_are_no_numbers():
    names = ["f_10", "f_9", "1²", "²"]
    ordered = sorted((PurePath(f"{name}.ply") for name in names), key=by_number)
    assert [path.stem for path in ordered] == ["1²", "f_9", "f_10", "²"]


FRAMES = paths(*(f"crane/{i}.ply" for i in range(12)), *(f"samba/{i}.ply" for i in range(10)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0.2, 10, "last"), r"^gap must .*, got 10: crane has 12 frame.*2 of them.* at most 9, or"),
        ((0.99, 2, "last"), r"crane has 12 frame.*12 of them.* leave this sequence out"),
        ((0.2, 5, "spread"), r"^gap must .*, got 5.* at most 2, or"),
    ],
)
def test_split_by_time_invalid_argument_raises(settings, message):
    with pytest.raises(UserError, match=message):
        split_by_time(FRAMES, *settings)
