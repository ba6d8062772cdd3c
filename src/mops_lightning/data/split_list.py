"""Lists that assign files to the training and the test split."""

import csv
from pathlib import Path, PurePosixPath

from mops_lightning.errors import UserError

SPLITS = ("train", "test")


def read_split_list(
    root: Path, split_file: Path, suffixes: tuple[str, ...], classes: bool = True
) -> list[tuple[PurePosixPath, str]]:
    """Read and check a list of files: a path relative to ``root`` and a split per line.

    Args:
        root: the folder of the files.
        split_file: relative to the working directory or to ``root``.
        suffixes: what the paths may end in.
        classes: whether every path must start with the folder of a class.

    Returns:
        Paths and splits, in the order of the list.

    Raises:
        UserError: the list cannot be read, or a line is wrong.
    """
    path = split_file if split_file.is_file() else root / split_file
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"split_file: cannot read {split_file}: {error}.") from error
    rows: dict[PurePosixPath, str] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = [field.strip() for field in next(csv.reader([line]))]
        if fields == ["path", "split"] and not rows:
            continue
        where = f"split_file: {path}, line {number}:"
        if len(fields) != 2 or fields[1] not in SPLITS:
            raise UserError(f"{where} must read 'path,train' or 'path,test', got {line!r}.")
        name = PurePosixPath(fields[0])
        form, parts = ("CLASS/…/FILE", 2) if classes else ("FILE or FOLDER/…/FILE", 1)
        if name.is_absolute() or ".." in name.parts or len(name.parts) < parts:
            raise UserError(
                f"{where} the path must be {form}, relative to {root}, got {fields[0]!r}."
            )
        if name.suffix.lower() not in suffixes:
            raise UserError(f"{where} {name} must end in {', '.join(suffixes)}.")
        if name in rows:
            raise UserError(f"{where} {name} is listed twice.")
        if not (root / name).is_file():
            raise UserError(f"{where} {root / name} does not exist.")
        rows[name] = fields[1]
    if not rows:
        raise UserError(f"split_file: {path} lists no file.")
    return list(rows.items())
