"""Settings of earlier versions: what they are called now, and records brought up to date."""

import re
from dataclasses import dataclass
from typing import Any

from mops_lightning.errors import UserError


@dataclass(frozen=True)
class Now:
    """What became of an old setting.

    Attributes:
        key: its new key; empty where there is none. Keys below an old key are below the new one.
        source: the old key was only where other settings took their values from. A record has
            those values too, so that its configuration loses the key.
        hint: what to use instead, where there is no new key.
    """

    key: str = ""
    source: bool = False
    hint: str = ""


OLD: dict[str, Now] = {
    "task_rate": Now("task_lr_scale"),
    "noise": Now("test_noise_std"),
    "optimizer.optimizer": Now("optimizer"),
    "pretrain.optimizer.optimizer": Now("pretrain"),
    "pretrain.optimizer": Now("pretrain"),
    "pretrain.max_epochs": Now("epochs.task"),
    "callbacks.stop": Now(hint="a run always stops between two steps"),
    "epochs.joint": Now("epochs.sampler", source=True),
    "epochs.nothing": Now(hint="learn=nothing trains nothing"),
    "augment.joint": Now("augment.sampler", source=True),
    "sampler.sizes_per_step": Now("sampler.size_sampling"),
    "sampler.prefixes": Now("sampler.num_sizes"),
    "sampler.over_sizes": Now("sampler.size_reduction"),
    "sampler.least": Now("sampler.min_size"),
    "paper.alpha": Now("sampler.alpha", source=True),
    "paper.tau_min": Now("sampler.tau_min", source=True),
    "paper.lr": Now("optimizer.lr", source=True),
    "paper.end_lr": Now("optimizer.schedule.end_lr", source=True),
    "paper.max_epochs": Now("epochs.sampler", source=True),
    "paper": Now(hint="use experiment=TASK_paper"),
    "rivals.snet.lr": Now(hint="use optimizer.lr"),
    "rivals.snet.progressive.least": Now("sampler.min_size", source=True),
    "rivals.snet.progressive.over_sizes": Now("sampler.size_reduction", source=True),
    "rivals.snet.progressive": Now("sampler", source=True),
    "rivals.snet": Now("sampler", source=True),
    "rivals.samplenet": Now("sampler", source=True),
    "rivals": Now(hint="use sampler=snet or sampler=samplenet and sampler.KEY"),
    "schedules": Now(hint="use epochs.task and epochs.sampler"),
    "dataset.sha256": Now(hint="use dataset.archive_hash=sha256:HASH"),
    "dataset.size": Now(hint="use dataset.archive_hash"),
    "labels": Now(hint="use hydra.run.dir"),
}
"""Old key, or what it starts with, and what became of it; the longest entry counts."""

MOVED = {
    "mops_lightning.schedules.": "mops_lightning.training.schedules.",
    "mops_lightning.rigid_losses.": "mops_lightning.losses.registration.",
}
"""What the path of a ``_target_`` started with, and starts with now."""


def find(key: str) -> tuple[Now, str] | None:
    """Return what became of an old key, and its new key or "".

    Args:
        key: dotted, such as ``optimizer.optimizer.lr``.

    Returns:
        None if the key is not an old one.
    """
    parts = re.split(r"(?=\.)", key)
    for count in range(len(parts), 0, -1):
        now = OLD.get("".join(parts[:count]))
        if now is not None:
            return now, now.key + "".join(parts[count:]) if now.key else ""
    return None


def answer(key: str) -> str | None:
    """Return one line that says what to use instead of an old key; None if it is not an old one."""
    found = find(key)
    if found is None:
        return None
    now, new = found
    return f"{key} is now called {new}." if new else f"{key} is no longer a setting: {now.hint}."


def upgraded_overrides(overrides: list[str]) -> list[str]:
    """Return overrides with the settings' present names, without those that are gone."""
    kept = []
    for override in overrides:
        match = re.fullmatch(r"([+~]*)([^=]*)(=?.*)", override, re.DOTALL)
        assert match is not None  # the pattern takes any text
        sign, key, value = match.groups()
        found = find(key)
        if found is None:
            kept.append(override)
        elif found[1]:
            kept.append(sign + found[1] + value)
    return kept


def upgraded_config(config: dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a record under the settings' present names.

    Args:
        config: nested and resolved, of any version.

    Raises:
        UserError: it is not the configuration of a run.
    """
    try:
        return _upgraded(config)
    except (AttributeError, KeyError, TypeError, RecursionError):
        raise UserError("config does not hold the settings of a run.") from None


def _upgraded(config: dict[str, Any]) -> dict[str, Any]:
    new: dict[str, Any] = {}
    _copy(config, "", new)
    # Keys that gave way to others, where a run used their values.
    if config.get("learn") == "joint":
        for group in ("epochs", "augment"):
            if "joint" in (config.get(group) or {}):
                new[group]["sampler"] = config[group]["joint"]
    for optimizer in (new.get("optimizer"), new.get("pretrain")):
        if isinstance(optimizer, dict):
            for node in (optimizer, optimizer.get("schedule") or {}):
                node.pop("_partial_", None)
    for node in (new.get("baselines") or {}).values():
        _drop(node, {"m": new.get("m"), "seed": new.get("seed"), **UNSET})
    for node in (new.get("augment") or {}).values():
        _drop(node, {"jitter_clip": 0.05})
    _drop(new.get("sampler"), {"annealing": "exponential"})
    return new


def _drop(node: Any, given: dict[str, Any]) -> None:
    """Remove settings that files no longer set, where they have the given values."""
    for key, value in given.items():
        if isinstance(node, dict) and key in node and node[key] == value:
            del node[key]


UNSET = {"start": None, "pick": "nearest"}
"""Settings of baselines that files no longer set, at their defaults."""


def _copy(old: dict[str, Any], path: str, new: dict[str, Any]) -> None:
    """Copy settings below ``path`` into ``new`` under their new keys."""
    for name, value in old.items():
        key = f"{path}.{name}" if path else str(name)
        found = find(key)
        if found and (found[0].source or not found[1]):
            continue
        if isinstance(value, dict) and value:
            _copy(value, key, new)
            continue
        *above, last = (found[1] if found else key).split(".")
        node = new
        for part in above:
            node = node.setdefault(part, {})
        node[last] = _moved(value) if last == "_target_" else value


def _moved(target: Any) -> Any:
    for old, now in MOVED.items():
        if str(target).startswith(old):
            return now + target.removeprefix(old)
    return target
