"""Nested settings as one table."""

from typing import Any


def dotted(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested settings under dotted keys; lists are leaves."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    leaves: dict[str, Any] = {}
    for key, below in tree.items():
        path = f"{prefix}.{key}" if prefix else str(key)
        leaves.update(dotted(below, path))
    return leaves
