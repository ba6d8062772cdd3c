"""Check that the results of runs are comparable, so that one table may show them."""

import json
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.records.run_record import RunRecord
from mops_lightning.report.collect import seed, trained_with


def shared_names(found: list[RunRecord], mixed: bool = False) -> dict[str, str]:
    """Return what all records must share: names of task, net and dataset, ``learned``, ``m``.

    A net without weights, such as ICP, may be in one table with the trained net.

    Args:
        found: completed records.
        mixed: whether different commits are allowed.

    Raises:
        UserError: the runs differ in something that must be equal, which the error names.
    """
    trained = [record for record in found if not _weightless(record)] or found
    shared = {
        "task": {record.config["names"]["task"] for record in found},
        "net": {record.config["names"]["net"] for record in trained},
        "dataset": {record.config["names"]["dataset"] for record in found},
        "pairs (task.pairs)": {_plain(record.config["task"].get("pairs")) for record in found},
        "what was trained (learn)": {trained_with(record) for record in trained},
    }
    for net in sorted({record.config["names"]["net"] for record in found}):
        same = [r.config["task"] for r in found if r.config["names"]["net"] == net]
        shared[f"settings of {net} (task.net)"] = {_plain(task.get("net")) for task in same}
    if any(trained_with(record) == "joint" for record in trained):
        losses = {_plain(record.config["task"].get("loss")) for record in trained}
        shared["loss (task.loss)"] = losses
    for what, values in shared.items():
        require_one(what, values - {None})
    same_for_every_seed("data (dataset_fingerprint)", "dataset_fingerprint", found)
    # Joint training gives each run its own task net.
    separate = [record for record in found if trained_with(record) != "joint"]
    same_for_every_seed("task weights (sha256)", "task_weights_sha256", separate)
    require_one_commit(found, mixed)
    names = {what: next(iter(shared[what]), "") or "" for what in ("task", "net", "dataset")}
    sizes = "/".join(str(m) for m in sorted({record.config["m"] for record in found}))
    return {**names, "learned": next(iter(shared["what was trained (learn)"]), ""), "m": sizes}


def require_one(what: str, values: set[Any]) -> None:
    """Raise a UserError if there are several values of something that must be equal."""
    if len(values) > 1:
        raise UserError(
            f"The runs differ in {what}: {', '.join(sorted(map(str, values)))}. Their results are "
            "not comparable; give a folder whose runs agree in it."
        )


def require_one_commit(found: list[RunRecord], mixed: bool) -> None:
    """Raise a UserError if runs of different commits are not allowed."""
    commits = sorted({commit(record) for record in found})
    if len(commits) > 1 and not mixed:
        raise UserError(
            f"The runs differ in the commit of the code: {', '.join(commits)}. Add --mixed to show "
            "them in one table."
        )


def commit(record: RunRecord) -> str:
    """Return the short commit of the code that made a record."""
    return (record.git["commit"] or "unknown")[:10]


def same_for_every_seed(what: str, name: str, found: list[RunRecord]) -> None:
    """Check that runs of one seed have the same data or nets, as a field of the records says.

    Seeds may differ in it, as with procedural data and nets that are trained first; then every
    sampler must have been run with every seed.

    Raises:
        UserError: they differ.
    """
    by_seed: dict[int, set[str]] = {}
    seeds: dict[str, set[int]] = {}
    for record in found:
        if known := getattr(record, name):  # absent where a checkpoint gave the net
            by_seed.setdefault(seed(record), set()).add(known)
            seeds.setdefault(record.config["names"]["sampler"], set()).add(seed(record))
    distinct = sorted({one for values in by_seed.values() for one in values})
    differ = any(len(values) > 1 for values in by_seed.values())
    uneven = len(distinct) > 1 and len({frozenset(values) for values in seeds.values()}) > 1
    if differ or uneven:
        listed = ", ".join(one[:12] for one in distinct)
        hint = " (if each seed has its own, every sampler must have every seed)" if uneven else ""
        raise UserError(
            f"The runs differ in {what}: {listed}{hint}. Their results are not comparable; give a "
            "folder whose runs agree in it."
        )


def _weightless(record: RunRecord) -> bool:
    """Return whether the task net has no weights: none are recorded, and none were trained."""
    trains = record.config["learn"] in ("task", "joint")
    return not trains and record.task_weights_sha256 is None


def _plain(node: Any) -> str | None:
    return None if node is None else json.dumps(node, sort_keys=True)
