"""Input files, and the output file of each."""

from collections import Counter
from os.path import realpath  # unlike Path.resolve, it accepts loops of symbolic links
from pathlib import Path

from mops_lightning.data.formats.registry import READABLE, WRITERS
from mops_lightning.errors import UserError
from mops_lightning.filesystem import is_temporary

FilePair = tuple[Path, Path]
"""An input file and its output file."""


def file_pairs(source: Path, target: Path) -> list[FilePair]:
    """Return the input files and their output files.

    An output file in a folder has the format of its input, or .ply where that cannot be written.

    Args:
        source: a file or a folder.
        target: a file or a folder; a folder if ``source`` is one.

    Raises:
        UserError: an input is missing, or an output is ambiguous or cannot be written.
    """
    if not source.exists():
        raise UserError(f"{source}: no such file or folder.")
    if realpath(target) == realpath(source):
        raise UserError(f"OUT must differ from IN, got {source} for both.")
    if blocking := next((p for p in target.parents if p.exists() and not p.is_dir()), None):
        raise UserError(f"OUT: {blocking} is a file, not a folder. Give another OUT.")
    if source.is_dir():
        inputs = _inputs(source, target)
        return _distinct(
            [(path, _output(path, target / path.relative_to(source))) for path in inputs]
        )
    if target.is_dir():
        target = _output(source, target / source.name)
    if target.suffix.lower() not in WRITERS:
        raise UserError(f"OUT must end in one of {', '.join(WRITERS)}, got {target}.")
    return [(source, target)]


def _output(source: Path, path: Path) -> Path:
    """Return ``path`` with the suffix of ``source``, or .ply where that cannot be written."""
    own = source.suffix.lower()
    return path.with_suffix(own if own in WRITERS else ".ply")


def _inputs(source: Path, target: Path) -> list[Path]:
    """Return the readable files below a folder, without those below ``target``."""
    if target.is_file():
        raise UserError(f"OUT must be a folder because IN is one, got the file {target}.")
    outputs = Path(realpath(target))
    files = sorted(
        path
        for path in source.rglob("*")
        if path.suffix.lower() in READABLE and path.is_file() and not is_temporary(path)
        if outputs not in Path(realpath(path)).parents
    )
    if not files:
        raise UserError(f"{source} contains no file that ends in {', '.join(READABLE)}.")
    return files


def _distinct(pairs: list[FilePair]) -> list[FilePair]:
    """Reject two input files with the same output file."""
    targets = Counter(path for _, path in pairs)
    twice = next((path for path, number in targets.items() if number > 1), None)
    if twice:
        both = " and ".join(str(source) for source, target in pairs if target == twice)
        raise UserError(f"{both} have the same output {twice}. Rename one.")
    return pairs
