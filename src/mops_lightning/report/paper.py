"""The paper's results, which reports show next to ours."""

import json
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def published_tables() -> dict[str, dict[str, Any]]:
    """Return all tables by name, each with its source; see ``paper.json``."""
    file = files("mops_lightning.report").joinpath("paper.json")
    return json.loads(file.read_text())


def published(
    task: str, net: str, dataset: str, metric: str, joint: bool = False
) -> dict[str, Any]:
    """Return the paper's table for a task, its net, dataset and metric; empty if it has none.

    Returns:
        ``rows``: sampler → size → values of generated, matched and completed sets, or one value;
        ``full``, if the paper gives it: the value on all points.
    """
    wanted = {
        "task": task,
        "dataset": dataset,
        "metric": metric,
        "net": net,
        "joint": joint,
    }
    defaults = {
        "dataset": None,
        "metric": None,
        "net": net,
        "joint": False,
    }
    for table in published_tables().values():
        given = defaults | table
        if all(given[name] == value for name, value in wanted.items()):
            return table
    return {}


def net(name: str, pieces: int | None, n_points: int | None) -> list[float] | None:
    """Return chamfer distance, earth mover's distance and size in MB of a reconstruction net.

    Args:
        name: such as ``autoencoder``.
        pieces: M of M-FoldingNet; FoldingNet has 1.
        n_points: points of the clouds.
    """
    nets = published_tables()["frameworks"]["nets"]
    if name in ("foldingnet", "mfoldingnet"):
        name = str(pieces)
    by_points = nets.get(name, {})
    return by_points.get(str(n_points))
