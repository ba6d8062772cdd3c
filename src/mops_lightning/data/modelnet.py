"""ModelNet40 in its public HDF5 format, ``modelnet40_ply_hdf5_2048``."""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

import torch

from mops_lightning.data.archive import unpack
from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes, select_classes
from mops_lightning.data.download import fetch, one_at_a_time
from mops_lightning.data.hdf5 import read_clouds, read_names
from mops_lightning.errors import UserError

FOLDER = "modelnet40_ply_hdf5_2048"
MIRRORS = (
    f"https://huggingface.co/datasets/Msun/modelnet40/resolve/main/{FOLDER}.zip",
    f"https://shapenet.cs.stanford.edu/media/{FOLDER}.zip",
)
LOOKED_FOR = "shape_names.txt, train_files.txt, test_files.txt and ply_data_{train,test}*.h5"


def modelnet40(
    root: str | Path,
    n_points: int = 1024,
    classes: Sequence[str] | None = None,
    download: bool = False,
    mirrors: Sequence[str] | None = None,
    archive_hash: str | None = None,
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
        mirrors: addresses of the archive, tried in turn; None means ``MIRRORS``.
        archive_hash: hexadecimal sha256 of the archive, or another hash as ``md5:...``; None
            accepts any archive.

    Returns:
        Float32 clouds ``(S, n_points, 3)`` and int64 labels ``(S,)``. The fingerprint depends on
        the file names, the data read from the files, ``n_points`` and the classes, but not on
        ``root``.

    Raises:
        UserError: an argument is invalid, or files are missing or damaged.
    """
    if n_points < 1:
        raise UserError(f"n_points must be at least 1, got {n_points}.")
    root = Path(root).expanduser()
    folder = _find(root)
    if folder is None and download:
        folder = _download(root, mirrors or MIRRORS, archive_hash)
    if folder is None:
        raise UserError(
            f"root: no ModelNet40 in {root}. Looked there and in {root / FOLDER} for {LOOKED_FOR}. "
            "Download it (dataset.download=true on the command line), or use another root."
        )
    known = read_names(folder / "shape_names.txt")
    chosen = choose_classes(classes, known)
    digest = hashlib.sha256(repr(("modelnet40", n_points, chosen)).encode())
    splits = []
    for split in ("train", "test"):
        files = _files(folder, split)
        parts = [read_clouds(path, n_points, len(known)) for path in files]
        whole = Clouds(
            torch.cat([part.points for part in parts]), torch.cat([part.labels for part in parts])
        )
        clouds = select_classes(whole, known, chosen) if len(chosen) < len(known) else whole
        if not len(clouds.labels):
            raise UserError(f"classes: {folder} has no {split} shape of {', '.join(chosen)}.")
        digest.update(repr((split, [f.name for f in files], tuple(clouds.points.shape))).encode())
        digest.update(clouds.points.numpy().data)
        digest.update(clouds.labels.numpy().data)
        splits.append(clouds)
    return CloudDataset(chosen, splits[0], splits[1], digest.hexdigest())


def _find(root: Path) -> Path | None:
    for folder in (root, root / FOLDER):
        names = [folder / name for name in ("shape_names.txt", "train_files.txt")]
        if any(name.is_file() for name in names) or any(folder.glob("ply_data_train*.h5")):
            return folder
    return None


def _download(root: Path, mirrors: Sequence[str], archive_hash: str | None) -> Path:
    folder = root if root.name == FOLDER else root / FOLDER
    archive = folder.parent / f"{FOLDER}.zip"
    with one_at_a_time(folder.parent / f".{FOLDER}.lock"):
        if _find(folder) is None:
            brought = archive.exists()
            fetch(mirrors, archive, archive_hash)
            unpack(archive, folder)
            if not brought:
                archive.unlink()
    if _find(folder) is None:
        raise UserError(
            f"mirrors: the archive unpacked into {folder} is not ModelNet40; it lacks "
            f"{LOOKED_FOR}. Remove the folder and use other mirrors."
        )
    return folder


def _lines(path: Path) -> list[str]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"root: cannot read {path}: {error}. ModelNet40 needs {LOOKED_FOR}."
        ) from error
    return [line.strip() for line in text.splitlines() if line.strip()]


def _files(folder: Path, split: str) -> list[Path]:
    """Return the files of a split; lists contain paths of other machines, so only names count."""
    listing = folder / f"{split}_files.txt"
    if listing.is_file():
        files = [folder / re.split(r"[/\\]", line)[-1] for line in _lines(listing)]
    else:
        found = folder.glob(f"ply_data_{split}*.h5")
        files = sorted(found, key=lambda f: (int(re.sub(r"\D", "", f.stem) or 0), f.name))
    if not files:
        raise UserError(f"root: no ply_data_{split}*.h5 in {folder}.")
    return files
