"""Models by name or address: where they are, and what a user's name, file or address means."""

import hashlib
import os
import re
from pathlib import Path

from mops_lightning.errors import UserError, did_you_mean, one_line
from mops_lightning.zoo import model_file

UNTRAINED = {
    "fps": "FPSSampler",
    "random": "RandomSampler",
    "voxel": "VoxelSampler",
    "poisson": "PoissonSampler",
}
"""Samplers without weights, public names of the package, by the name of the method."""
SHIPPED = Path(__file__).parent / "models"
"""The models that the package contains."""
VARIABLE = "MOPS_MODELS"
"""Environment variable: folders with models of the user's own."""
NAME = re.compile(r"[a-z0-9_-]+(\.[a-z0-9_-]+)+")
FILES = (".pt", ".ckpt", ".safetensors", ".json")
"""Suffixes of files; a name does not end in one."""
PIN = "@sha256:"
"""Between a name and the sha256 that its tensors must have."""
HUB = "hf://"
ADDRESS = re.compile(
    r"hf://(?P<repo>[\w.-]+/[\w.-]+)/(?P<file>[\w./-]+\.safetensors)@sha256:(?P<sha256>[0-9a-f]{64})"
)


def folders() -> list[Path]:
    """Return the folders with models: those in ``MOPS_MODELS`` first, then the package's own."""
    own = os.environ.get(VARIABLE, "").split(os.pathsep)
    return [*(Path(folder).expanduser() for folder in own if folder), SHIPPED]


def available() -> dict[str, Path]:
    """Return the files of all models by name, sorted."""
    models: dict[str, Path] = {}
    for folder in reversed(folders()):
        files = folder.glob(f"*{model_file.SUFFIX}")
        models |= {path.stem: path for path in files if is_name(path.stem) and path.is_file()}
    return dict(sorted(models.items()))


def is_name(text: str) -> bool:
    """Return whether a model can be called this."""
    return bool(NAME.fullmatch(text)) and not text.endswith(FILES) and len(text) <= 100


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
    """Return the path that a user means: an existing file or folder, a model or an address.

    Args:
        reference: a path, the name of a model, or ``hf://OWNER/REPO/FILE@sha256:HASH``.

    Returns:
        A path. It may not exist if it contains a folder or ends like a file.

    Raises:
        UserError: there is no file and no model of this name; the nearest names are listed.
    """
    text = str(reference)
    if text.startswith(HUB):
        return fetch(text)
    path = Path(text).expanduser()
    if path.exists():
        return path
    model = find_model(text)
    if model is not None:
        return model
    if path.name != text or text.endswith(FILES):
        return path
    raise UserError(f"no file or model {text!r}.{did_you_mean(text, available())}")


def fetch(address: str) -> Path:
    """Return a file of the Hugging Face Hub, downloaded if it is not in the cache.

    Args:
        address: ``hf://OWNER/REPO/FILE.safetensors@sha256:HASH``, with the sha256 of the file.

    Raises:
        UserError: the address has another form, huggingface_hub is not installed, the file cannot
            be downloaded, or has another hash.
    """
    match = ADDRESS.fullmatch(address)
    if match is None:
        raise UserError(
            f"{address}: the address of a model must be "
            "hf://OWNER/REPO/FILE.safetensors@sha256:HASH. The publisher names the hash "
            "(sha256sum FILE)."
        )
    try:
        from huggingface_hub import hf_hub_download
    except ModuleNotFoundError:
        raise UserError(
            f"{address} needs huggingface_hub: pip install 'mops-lightning[hub]'."
        ) from None
    try:
        path = Path(hf_hub_download(match["repo"], match["file"]))
    except Exception as error:  # errors of several HTTP libraries
        raise UserError(f"{address} cannot be downloaded: {one_line(error)}") from None
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != match["sha256"]:
        raise UserError(f"{address}: the downloaded file has another sha256, {digest}.")
    return path
