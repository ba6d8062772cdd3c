"""Files on which a run was trained are left out of a comparison."""

from pathlib import PurePosixPath

import pytest

from mops_lightning.data.file_splits import split_by_share
from mops_lightning.files.task_net.held_out import files_of, without_training_files

NAMES = [f"scan_{number}.ply" for number in range(10)]


@pytest.fixture
def files(tmp_path):
    for name in NAMES:
        (tmp_path / name).touch()
    return [tmp_path / name for name in NAMES]


def dataset(files, **settings):
    folder = files[0].parent
    node = {"root": str(folder), "test_share": 0.3}
    return {"dataset": {**node, **settings}}


def names_of(files):
    return [file.name for file in files]


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_kept_files_are_the_test_files_of_the_runs_own_seed(seed, files, capsys):
    run = dataset(files, seed=seed)

    kept = without_training_files(files, [run])

    paths = [PurePosixPath(name) for name in NAMES]
    split = split_by_share(paths, 0.3, seed)
    expected = [str(file.name) for file in split if file.split == "test"]
    assert names_of(kept) == expected
    assert "7 of 10 files left out" in capsys.readouterr().err


def test_kept_files_of_frames_are_those_after_the_training_and_its_gap_too(files):
    run = dataset(files, test_frames="last", gap=2, seed=3)

    kept = without_training_files(files, [run])

    assert names_of(kept) == NAMES[5:]


def test_files_that_any_run_was_trained_on_are_left_out(files):
    first = dataset(files, test_share=0.7, seed=0)
    second = dataset(files, test_share=0.7, seed=1)

    kept = without_training_files(files, [first, second])

    of_first = without_training_files(files, [first])
    of_second = without_training_files(files, [second])
    assert kept == [file for file in of_first if file in of_second]
    assert len(kept) < len(of_first)


def test_files_of_classes_that_a_run_did_not_take_are_kept(tmp_path):
    files = []
    for name in ("car", "tree"):
        (tmp_path / name).mkdir()
        for number in range(6):
            path = tmp_path / name / f"{number}.ply"
            path.touch()
            files.append(path)
    run = {"dataset": {"root": str(tmp_path), "test_share": 0.5, "classes": ["car"]}}

    kept = without_training_files(files, [run])

    classes = [file.parent.name for file in kept]
    assert classes == ["car"] * 3 + ["tree"] * 6


def test_file_that_several_paths_name_is_compared_once(files):
    folder = files[0].parent
    link = folder / "link.ply"
    link.symlink_to(files[3])

    found = files_of([files[3], folder, files[0]])

    assert found == [files[3], *files[:3], *files[4:]]
