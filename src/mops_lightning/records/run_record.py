"""``result.json``: what every run leaves behind, failed ones too."""

import json
import math
import platform
import subprocess
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.files import atomic_write

SCHEMA = "mops_lightning/result/1"
FILE = "result.json"
PACKAGES = (
    "mops-lightning",
    "torch",
    "lightning",
    "hydra-core",
    "torchmetrics",
    "trimesh",
    "numpy",
)


@cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of a run record."""
    text = files("mops_lightning.records").joinpath("result.schema.json").read_text()
    return json.loads(text)


def write(folder: Path, record: dict[str, Any]) -> Path:
    """Validate a record and write it as ``result.json``; numbers that are not finite become null.

    Args:
        folder: the run's folder.
        record: see ``result.schema.json``.

    Raises:
        jsonschema.ValidationError: the record does not fit the schema, which is a bug here.
    """
    import jsonschema

    record = _finite(record)
    jsonschema.validate(record, schema())
    path = folder / FILE
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    return path


def read(folder: Path) -> dict[str, Any]:
    """Read and validate the record in ``folder``.

    Raises:
        UserError: there is none, or it is not one.
    """
    import jsonschema

    path = folder / FILE
    try:
        record = json.loads(path.read_text())
        jsonschema.validate(record, schema())
    except FileNotFoundError:
        raise UserError(f"{path}: no run record there; give a run's folder.") from None
    except (json.JSONDecodeError, jsonschema.ValidationError) as error:
        raise UserError(f"{path}: not a run record: {str(error).splitlines()[0]}") from None
    return record


def dotted(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested settings under dotted keys; lists are leaves."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    leaves: dict[str, Any] = {}
    for key, below in tree.items():
        leaves |= dotted(below, f"{prefix}.{key}" if prefix else str(key))
    return leaves


def environment() -> dict[str, Any]:
    """Return versions, machine and the commit of the code, as plain data."""
    import torch

    return {
        "versions": {"python": platform.python_version(), **_versions()},
        "platform": f"{platform.system()} {platform.machine()}",
        "threads": torch.get_num_threads(),
        "git": git_state(),
    }


def git_state() -> dict[str, Any]:
    """Return the commit of the checkout that this package runs from, and whether it was changed.

    Both are None for an installed wheel.
    """
    here = Path(__file__).resolve().parent
    top = here.parents[2]
    if not (top / ".git").exists():
        return {"commit": None, "dirty": None}
    try:
        commit = _git(top, "rev-parse", "HEAD")
        dirty = _git(top, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}
    return {"commit": commit, "dirty": bool(dirty)}


def _git(top: Path, *arguments: str) -> str:
    command = ["git", "-C", str(top), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
