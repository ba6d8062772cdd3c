"""Counts of GLB files, compared with the length of the file before trimesh makes arrays."""

import json
from typing import Any

TIMES = 100
"""Most values that a scene may have per byte of its file, by repeating meshes."""


def check(data: bytes) -> None:
    """Reject a scene that would take much more memory than its file.

    Args:
        data: content of the file.

    Raises:
        ValueError: a count is too large, or the parts of the scene are no tree.
    """
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    limit = TIMES * len(data)
    counts = [accessor["count"] for accessor in tree.get("accessors", [])]
    if sum(counts) > limit:
        raise ValueError(f"{sum(counts)} values announced in {len(data)} bytes")
    sizes = [_values(mesh, counts) for mesh in tree.get("meshes", [])]
    nodes: list[dict[str, Any]] = tree.get("nodes", [])
    total = sum(sizes) + sum(sizes[node["mesh"]] for node in nodes if "mesh" in node)
    if total > limit:
        raise ValueError(f"{total} values announced in {len(data)} bytes")
    children = [child for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children):
        raise ValueError("a part of the scene has two parents")
    roots = set(range(len(nodes))) - set(children)
    if nodes and not roots:
        raise ValueError("the parts of the scene form a circle")


def _values(mesh: dict[str, Any], counts: list[int]) -> int:
    """Return the number of values of a mesh's accessors."""
    used = [
        place
        for part in mesh["primitives"]
        for place in (*part["attributes"].values(), part.get("indices"))
    ]
    return sum(counts[place] for place in used if place is not None)
