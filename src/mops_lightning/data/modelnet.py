"""ModelNet40 in its public HDF5 format, ``modelnet40_ply_hdf5_2048``."""

import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pooch
import torch
from filelock import FileLock

from mops_lightning.data.clouds import CloudDataset, Clouds, make_dataset
from mops_lightning.data.hdf5 import read_clouds, read_lines, read_names
from mops_lightning.errors import UserError, one_line

FOLDER = "modelnet40_ply_hdf5_2048"
MIRRORS = (
    f"https://huggingface.co/datasets/Msun/modelnet40/resolve/main/{FOLDER}.zip",
    f"https://shapenet.cs.stanford.edu/media/{FOLDER}.zip",
)
ARCHIVE_HASH = "md5:c9ab8e6dfb16f67afdab25e155c79e59"
TIMEOUT = 60.0
"""Seconds without a byte after which a mirror is given up."""

LOOKED_FOR = "shape_names.txt, train_files.txt, test_files.txt and the files that they list"


def modelnet40(
    root: str | Path,
    n_points: int = 1024,
    classes: Sequence[str] | None = None,
    download: bool = False,
) -> CloudDataset:
    """Read ModelNet40, the dataset of the paper's classification and registration experiments.

    The official split is used, with all training and all test shapes. Clouds are in the unit
    sphere, with y up. Their points are stored in random order, so that the first ``n_points`` are
    a random subset.

    Args:
        root: the folder with the files, or its parent folder.
        n_points: number of points per shape, at most the number that is stored.
        classes: names from ``shape_names.txt`` to keep; None or empty means all 40.
        download: whether to download the archive into ``root`` if the files are missing.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` and int64 labels ``(S,)``. The fingerprint depends on
        the file names, the data read from the files, ``n_points`` and the classes, but not on
        ``root``.

    Raises:
        UserError: an argument is invalid, or files are missing or damaged.
    """
    root = Path(root).expanduser()
    folder = _find(root)
    if folder is None and download:
        folder = _download(root)
    if folder is None:
        raise UserError(
            f"root: no ModelNet40 in {root}. Looked there and in {root / FOLDER} for {LOOKED_FOR}. "
            "Download it (dataset.download=true on the command line), or use another root."
        )
    known = read_names(folder / "shape_names.txt")
    files = {split: _files(folder, split) for split in ("train", "test")}
    splits = {}
    for split, paths in files.items():
        parts = [read_clouds(path, n_points, len(known)) for path in paths]
        splits[split] = Clouds(
            torch.cat([part.points for part in parts]), torch.cat([part.labels for part in parts])
        )
    names = {split: [path.name for path in paths] for split, paths in files.items()}
    return make_dataset("modelnet40", splits, known, classes, folder, names)


def _find(root: Path) -> Path | None:
    folders = (root, root / FOLDER)
    return next((folder for folder in folders if (folder / "train_files.txt").is_file()), None)


def _download(root: Path) -> Path:
    """Download and unpack the archive; of several processes, one does it and the others wait."""
    folder = root if root.name == FOLDER else root / FOLDER
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(folder.parent / f".{FOLDER}.lock"):
            if _find(folder) is None:
                archive = _fetch(folder.parent)
                prefix = f".{folder.name}-"  # unpacked completely or not at all
                with tempfile.TemporaryDirectory(dir=folder.parent, prefix=prefix) as name:
                    shutil.unpack_archive(archive, name)
                    (Path(name) / FOLDER).replace(folder)
                archive.unlink()
    except OSError as error:
        raise UserError(f"Cannot download ModelNet40 into {folder.parent}: {error}.") from error
    return folder


def _fetch(folder: Path) -> Path:
    """Download the archive from the first mirror that has it; a file with its hash is kept."""
    pooch.get_logger().setLevel("WARNING")
    downloader = pooch.HTTPDownloader(progressbar=sys.stderr.isatty(), timeout=TIMEOUT)
    answers = []
    for url in MIRRORS:
        try:
            name = pooch.retrieve(url, ARCHIVE_HASH, f"{FOLDER}.zip", folder, downloader=downloader)
        except (OSError, ValueError) as error:  # an answer of the network, or another hash
            answers.append(f"{url}: {one_line(error)}")
        else:
            return Path(name)
    raise UserError(
        f"No mirror served ModelNet40 ({'; '.join(answers)}). Check the network and try again, or "
        f"save the file as {folder / f'{FOLDER}.zip'} yourself."
    )


def _files(folder: Path, split: str) -> list[Path]:
    """Return the files of a split; the list contains paths of other machines: only names count."""
    lines = read_lines(folder / f"{split}_files.txt")
    files = [folder / re.split(r"[/\\]", line)[-1] for line in lines]
    if not files:
        raise UserError(f"root: {folder / f'{split}_files.txt'} lists no files.")
    return files
