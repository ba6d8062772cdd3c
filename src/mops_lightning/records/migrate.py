"""Settings that were renamed, so that old records and command lines can be read."""

from typing import Any

RENAMED = {
    "noise": "test_noise_std",
    "task_rate": "task_lr_scale",
}
"""Old dotted setting → new one."""


def new_path(path: str) -> str:
    """Return the present name of a dotted setting, or of one inside it."""
    for old, new in RENAMED.items():
        if path == old or path.startswith(f"{old}."):
            return new + path[len(old) :]
    return path


def config(old: dict[str, Any]) -> dict[str, Any]:
    """Return a record's settings under their present names."""
    return {new_path(key): value for key, value in old.items()}
