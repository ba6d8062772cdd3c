"""Model files on the Hugging Face Hub, with a hash."""

import hashlib
import os
import re
from pathlib import Path

from mops_lightning.errors import UserError

SCHEME = "hf://"
ADDRESS = re.compile(
    r"hf://(?P<repo>[\w.-]+/[\w.-]+)/(?P<file>[\w./-]+\.safetensors)@sha256:(?P<sha256>[0-9a-f]{64})"
)


def fetch(address: str) -> Path:
    """Return a file of the Hub, downloaded if it is not in huggingface_hub's cache.

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
        mirror = os.environ.get("HF_ENDPOINT")  # the library reads it only when it is imported
        path = Path(hf_hub_download(match["repo"], match["file"], endpoint=mirror))
    except Exception as error:  # errors of several HTTP libraries
        reason = str(error).strip().partition("\n")[0]
        raise UserError(
            f"{address} cannot be downloaded ({type(error).__name__}: {reason}). "
            "Check the address and the connection."
        ) from None
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != match["sha256"]:
        raise UserError(f"{address}: the downloaded file has another sha256, {found}.")
    return path
