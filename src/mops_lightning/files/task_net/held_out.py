"""The files of a comparison: without those on which a net or a sampler was trained."""

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mops_lightning.data.file_splits import (
    class_of,
    list_files,
    split_by_folder,
    split_by_share,
    split_by_time,
)
from mops_lightning.data.formats.guard import check_is_file
from mops_lightning.data.formats.registry import READABLE
from mops_lightning.errors import UserError


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files that paths name, without duplicates: those of a folder, and files.

    Raises:
        UserError: a path does not exist, or a folder has no file that can be read.
    """
    files: dict[Path, Path] = {}
    for path in paths:
        if path.is_dir():
            try:
                found = [path / name for name in list_files(path, READABLE)]
            except UserError as error:
                raise UserError(str(error).removeprefix("root: ")) from None
        else:
            check_is_file(path)
            found = [path]
        for file in found:
            files.setdefault(file.resolve(), file)
    return list(files.values())


def without_training_files(files: Sequence[Path], configs: Iterable[dict[str, Any]]) -> list[Path]:
    """Leave out the files on which runs were trained, and say so.

    Args:
        files: of the comparison.
        configs: the settings of the runs; empty for what was not trained by a run.

    Raises:
        UserError: no file is left.
    """
    trained: set[Path] = set()
    for config in configs:
        trained |= _training_files(config.get("dataset") or {})
    kept = [file for file in files if file.resolve() not in trained]
    number = len(files) - len(kept)
    if not kept:
        raise UserError("the net or the sampler was trained on all of these files. Give others.")
    if number:
        print(
            f"{number} of {len(files)} files left out: the net or the sampler was trained on them.",
            file=sys.stderr,
        )
    return kept


def _training_files(dataset: dict[str, Any]) -> set[Path]:
    """Return the training files of a data set of files, as far as its folder is still there."""
    root = dataset.get("root")
    share = dataset.get("test_share")
    if not isinstance(root, str) or not isinstance(share, float):
        return set()
    folder = Path(root).expanduser()
    if not folder.is_dir():
        return set()
    try:
        names = list_files(folder, READABLE)
        classes = dataset.get("classes")
        if classes:
            names = [name for name in names if class_of(name) in classes]
        if dataset.get("test_frames") == "last":
            split = split_by_time(names, share, dataset.get("gap") or 0)
        else:
            seed = dataset.get("seed") or 0
            split = split_by_folder(names) or split_by_share(names, share, seed)
    except UserError:  # the folder has changed since
        return set()
    trained = [file for file in split if file.split == "train"]
    return {(folder / file.name).resolve() for file in trained}
