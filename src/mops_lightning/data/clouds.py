"""What every dataset is once loaded: two splits of clouds in memory."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mops_lightning.errors import UserError, did_you_mean


class Clouds(NamedTuple):
    """One split.

    Attributes:
        points: ``(S, N, 3)`` float32.
        labels: ``(S,)`` int64, positions in ``CloudDataset.class_names``.
    """

    points: Tensor
    labels: Tensor


@dataclass(frozen=True)
class CloudDataset:
    """A dataset in memory.

    Attributes:
        class_names: the classes, in the order of their labels.
        train: the clouds to learn from.
        test: the clouds to score; all of them are scored.
        fingerprint: sha256 of all that fixes the content; part of the name of cached weights.
        notes: plain facts worth recording with a run, such as how many meshes were skipped.
    """

    class_names: tuple[str, ...]
    train: Clouds
    test: Clouds
    fingerprint: str
    notes: dict[str, Any] = field(default_factory=dict)


def choose_classes(setting: Sequence[str] | None, known: Sequence[str]) -> tuple[str, ...]:
    """Return the classes to load, in the order in which the dataset knows them.

    Args:
        setting: ``dataset.classes``; None or empty means all.
        known: the dataset's classes.

    Raises:
        UserError: a class is unknown; the nearest known ones are named.
    """
    if isinstance(setting, str):
        raise UserError(f"dataset.classes must be a list, such as [{setting}], got {setting!r}.")
    if not setting:
        return tuple(known)
    for name in setting:
        if name not in known:
            raise UserError(f"dataset.classes: unknown class {name!r}.{did_you_mean(name, known)}")
    return tuple(name for name in known if name in set(setting))


def select_classes(clouds: Clouds, known: Sequence[str], chosen: Sequence[str]) -> Clouds:
    """Keep the clouds of the chosen classes and number these from 0.

    Args:
        clouds: labels are positions in ``known``.
        known: all classes.
        chosen: a subset of them, from ``choose_classes``.

    Returns:
        Clouds whose labels are positions in ``chosen``.
    """
    table = torch.full((len(known),), -1, dtype=torch.int64)
    for position, name in enumerate(chosen):
        table[list(known).index(name)] = position
    labels = table[clouds.labels]
    keep = labels >= 0
    return Clouds(clouds.points[keep], labels[keep])
