"""Models by name: where they are, and the file that a name, path or address means."""

import os
import re
from pathlib import Path

from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.zoo import addresses, model_file

UNTRAINED = {
    "fps": "FPSSampler",
    "random": "RandomSampler",
    "voxel": "VoxelSampler",
    "poisson": "PoissonSampler",
    "serial": "SerialSampler",
    "normal_space": "NormalSpaceSampler",
    "covariance": "CovarianceSampler",
    "information": "InformationSampler",
    "steady": "SteadySampler",
}
"""Samplers without weights, public names of the package, by the name of the method."""
SHIPPED = Path(__file__).parent / "models"
"""The models that the package contains."""
VARIABLE = "MOPS_MODELS"
"""Environment variable: folders with models of the user's own."""
FILES = (".pt", ".ckpt", ".safetensors", ".json")
"""Suffixes of files; a name does not end in one."""
PIN = "@sha256:"
"""Between a name and the sha256 that its tensors must have."""


def folders() -> list[Path]:
    """Return the folders with models: those in ``MOPS_MODELS`` first, then the package's own."""
    own = os.environ.get(VARIABLE, "").split(os.pathsep)
    return [*(Path(folder).expanduser() for folder in own if folder), SHIPPED]


def available() -> dict[str, Path]:
    """Return the files of all models by name, sorted."""
    models: dict[str, Path] = {}
    for folder in reversed(folders()):
        models |= in_folder(folder)
    return dict(sorted(models.items()))


def in_folder(folder: Path) -> dict[str, Path]:
    """Return the files of a folder's models by name."""
    files = folder.glob(f"*{model_file.SUFFIX}")
    return {path.stem: path for path in files if is_name(path.stem) and path.is_file()}


def is_name(text: str) -> bool:
    """Return whether a model can be called this."""
    matches = bool(re.fullmatch(model_file.NAME_PATTERN, text))
    return matches and not text.endswith(FILES) and len(text) <= 100


def pinned(name: str, sha256: str) -> str:
    """Return a reference to a model that holds for these tensors only."""
    return f"{name}{PIN}{sha256}"


def find_model(reference: str) -> Path | None:
    """Return the file of a model, or None if there is no model of this name.

    Args:
        reference: ``NAME``, or ``NAME@sha256:HASH`` with the hash of its tensors.

    Raises:
        UserError: the model has another hash.
    """
    name, _, sha256 = reference.partition(PIN)
    path = available().get(name)
    if path is not None and sha256 and model_file.read_card(path)["sha256"] != sha256:
        raise UserError(
            f"{name}: the model now has other weights than those with sha256 {sha256}, which are "
            "not kept. Install the version of mops_lightning that has them, or give a file."
        )
    return path


def resolve(reference: str | Path) -> Path:
    """Return the path that a user means: an existing file or folder, a model, or a download.

    Args:
        reference: a path, with or without ``.safetensors``, the name of a model, or an address with
            a hash; see ``addresses``.

    Returns:
        A path. It may not exist if it contains a folder or ends like a file.

    Raises:
        UserError: there is no file and no model of this name; the nearest names are listed. Or the
            address has no valid file.
    """
    text = str(reference)
    if addresses.is_address(text):
        return addresses.fetch(text)
    path = Path(text).expanduser()
    if path.exists():
        return path
    model = find_model(text)
    if model is not None:
        return model
    saved = path.with_name(f"{path.name}{model_file.SUFFIX}")
    if not text.endswith(FILES) and saved.is_file():
        return saved
    if path.name != text or text.endswith(FILES):
        return path
    hint = did_you_mean(text, available())
    raise UserError(f"no file or model {text!r}.{hint} `mops-lightning models` lists all models.")
