"""The environment of a run: versions, machine and commit."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGES = (
    "mops-lightning",
    "torch",
    "lightning",
    "hydra-core",
    "torchmetrics",
    "trimesh",
    "numpy",
)
"""Packages whose versions are recorded."""


def environment() -> dict[str, Any]:
    """Return versions, machine and the commit of the code, as plain data."""
    import torch

    return {
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in PACKAGES},
        "platform": f"{platform.system()} {platform.machine()}",
        "threads": torch.get_num_threads(),
        "git": git_state(),
    }


def git_state() -> dict[str, Any]:
    """Return the commit of the checkout that this package runs from, and whether it has changes.

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
