"""Data sets in memory: a training and a test split of clouds."""

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mops_lightning.channels import NO_CHANNELS, PointChannels, coordinates, with_coordinates
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.seeding import generator
from mops_lightning.types import UNKNOWN

MOST_PARTS = 1000
"""A column of more different numbers tells objects or points apart, not parts."""
NOISE = 13
"""Random stream of the noise on test clouds."""


class Clouds(NamedTuple):
    """One split.

    Attributes:
        points: ``(S, N, 3 + C)`` float32.
        labels: ``(S,)`` int64, positions in ``CloudDataset.class_names``.
        sources: ``(S,)`` int64, the same number for clouds that must be in the same split, such as
            the crops of a file; None: no two must.
        parts: ``(S, N)`` int64, positions in ``CloudDataset.part_names`` or ``UNKNOWN``, or None.
        sizes: ``(S,)`` int64, the number of points of every cloud; the rows behind them repeat the
            cloud. None: every cloud has N points.
    """

    points: Tensor
    labels: Tensor
    sources: Tensor | None = None
    parts: Tensor | None = None
    sizes: Tensor | None = None

    @property
    def smallest(self) -> tuple[int, int]:
        """The row of the cloud with the fewest points, and their number."""
        if self.sizes is None:
            return 0, self.points.shape[1]
        row = int(self.sizes.argmin())
        return row, int(self.sizes[row])

    def take(self, rows: Tensor) -> "Clouds":
        """Return the clouds of the given rows, or of a mask, with all that belongs to them."""
        return Clouds(
            self.points[rows],
            self.labels[rows],
            _rows_of(self.sources, rows),
            _rows_of(self.parts, rows),
            _rows_of(self.sizes, rows),
        )


def _rows_of(values: Tensor | None, rows: Tensor) -> Tensor | None:
    if values is None:
        return None
    return values[rows]


@dataclass(frozen=True)
class CloudDataset:
    """A dataset in memory.

    Attributes:
        class_names: the classes, in the order of their labels.
        train: the training split.
        test: the test split; all clouds are scored.
        fingerprint: sha256 of everything that determines the content; part of the cache key of task
            nets.
        notes: facts for the run record, such as the number of files.
        part_names: the parts of shapes, in the order of ``Clouds.parts``; empty without parts.
        channels: of the points, beside x, y and z.
    """

    class_names: tuple[str, ...]
    train: Clouds
    test: Clouds
    fingerprint: str
    notes: dict[str, Any] = field(default_factory=dict)
    part_names: tuple[str, ...] = ()
    channels: PointChannels = NO_CHANNELS

    def scaled_as(self, channels: PointChannels, source: str) -> "CloudDataset":
        """Return the data with channels scaled as those that a net was trained with.

        Args:
            channels: of the net.
            source: of the net, for the error.

        Raises:
            UserError: they have other names, or another order.
        """
        if channels == self.channels:
            return self
        if channels.names != self.channels.names:
            wanted = ", ".join(channels.features)
            found = ", ".join(self.channels.features) or "none"
            trained = "without features"
            advice = "Leave features out."
            if channels:
                trained = f"with the features {wanted}"
                advice = f"Set dataset.features=[{wanted}]."
            raise UserError(
                f"{source} was trained {trained}, but dataset.features gives {found}. {advice}"
            )
        train = self._rescaled(self.train, channels)
        test = self._rescaled(self.test, channels)
        return replace(self, train=train, test=test, channels=channels)

    def _rescaled(self, clouds: Clouds, channels: PointChannels) -> Clouds:
        values = self.channels.restored(clouds.points[..., 3:].double())
        scaled = channels.scaled(values).to(clouds.points.dtype)
        places = coordinates(clouds.points)
        return clouds._replace(points=torch.cat([places, scaled], -1))


def choose_classes(classes: Sequence[str] | None, known: Sequence[str]) -> tuple[str, ...]:
    """Return the classes to load, in the order of ``known``; None or empty means all.

    Raises:
        UserError: a class is unknown, or ``classes`` is not a list of names.
    """
    if not classes:
        return tuple(known)
    is_list = isinstance(classes, Sequence) and not isinstance(classes, str)
    if not is_list or not all(isinstance(name, str) for name in classes):
        raise UserError(f"classes must be a list of names, such as [{known[0]}], got {classes!r}.")
    for name in classes:
        if name not in known:
            hint = did_you_mean(name, known)
            raise UserError(f"classes: unknown class {name!r}.{hint}")
    return tuple(name for name in known if name in classes)


def make_dataset(
    kind: str,
    splits: Mapping[str, Clouds],
    known: Sequence[str],
    classes: Sequence[str] | None,
    folder: Path,
    files: Mapping[str, Sequence[str]] | None = None,
    channels: PointChannels = NO_CHANNELS,
) -> CloudDataset:
    """Keep the chosen classes of both splits and compute the fingerprint of the result.

    Args:
        kind: name of the data set, part of the fingerprint.
        splits: ``train`` and ``test``; labels are positions in ``known``.
        known: all classes.
        classes: names to keep; None or empty means all.
        folder: source of the files, for errors.
        files: names of the files of every split, part of the fingerprint; None leaves them out.
        channels: of the points.

    Raises:
        UserError: a class is unknown, or a split has no shapes.
    """
    chosen = choose_classes(classes, known)
    n_points = splits["train"].points.shape[1]
    settings = (kind, n_points, chosen)
    digest = hashlib.sha256(repr(settings).encode())
    if channels:
        digest.update(repr(channels.to_plain()).encode())
    # The new label of every class; -1 for those that are left out.
    new_labels = [chosen.index(name) if name in chosen else -1 for name in known]
    table = torch.tensor(new_labels)
    kept = []
    for split, clouds in splits.items():
        if len(chosen) < len(known):
            labels = table[clouds.labels]
            is_chosen = labels >= 0
            clouds = clouds._replace(labels=labels).take(is_chosen)
        if not len(clouds.labels):
            names_of_classes = ", ".join(chosen)
            raise UserError(f"classes: {folder} has no {split} shape of {names_of_classes}.")
        shape = tuple(clouds.points.shape)
        entry: tuple[Any, ...] = (split, shape)
        if files is not None:
            entry = (split, list(files[split]), shape)
        digest.update(repr(entry).encode())
        digest.update(clouds.points.numpy().data)
        digest.update(clouds.labels.numpy().data)
        if clouds.parts is not None:
            digest.update(clouds.parts.numpy().data)
        if clouds.sizes is not None:
            digest.update(clouds.sizes.numpy().data)
        kept.append(clouds)
    return CloudDataset(chosen, kept[0], kept[1], digest.hexdigest(), channels=channels)


def check_parts(dataset: CloudDataset) -> None:
    """Refuse points without known parts, or with too many; print the parts that a split lacks."""
    names = dataset.part_names
    if not 2 <= len(names) <= MOST_PARTS:
        found: str | int = len(names) or "none"
        if len(names) == 1:
            found = f"only part {names[0]}"
        raise UserError(
            f"dataset: its points must belong to 2 to {MOST_PARTS} parts, got {found}. Give "
            "dataset=shapes dataset.classes=parts, or your own clouds with dataset.label=COLUMN."
        )
    parts_of_splits = (
        ("training", dataset.train.parts),
        ("test", dataset.test.parts),
    )
    for split, parts in parts_of_splits:
        assert parts is not None
        known = parts[parts != UNKNOWN]
        counts = torch.bincount(known, minlength=len(names)).tolist()
        if not any(counts):
            raise UserError(f"dataset.label: no {split} point has a known part, 0 or more.")
        missing = [name for name, count in zip(names, counts, strict=True) if count == 0]
        if missing:
            text = ", ".join(missing)
            print(f"dataset: no {split} point of part {text:.200}.", file=sys.stderr)


def noisy(clouds: Clouds, noise: float) -> Clouds:
    """Add Gaussian noise to every coordinate, without clipping (paper, "Robustness Analysis").

    The noise of a cloud depends on its position in the split only, so that every method is tested
    on the same noisy clouds. Other standard deviations scale the same noise.

    Args:
        clouds: a split.
        noise: standard deviation in units of the coordinates; 0.1 is 10 % in the paper.
    """
    if not noise:
        return clouds
    points = coordinates(clouds.points)
    shape = points.shape[1:]
    drawn = []
    for number in range(len(points)):
        rng = generator(NOISE, number)
        drawn.append(torch.randn(shape, generator=rng))
    moved = points + noise * torch.stack(drawn)
    return clouds._replace(points=with_coordinates(clouds.points, moved))


def scale_warning(dataset: CloudDataset) -> str | None:
    """Return one line about training clouds far from the unit sphere, else None."""
    distances = coordinates(dataset.train.points).norm(dim=2)
    radius = distances.amax(1).median().item()
    if 0.5 <= radius <= 2:
        return None
    return (
        f"dataset: the farthest points of the clouds are about {radius:.3g} from the origin, but "
        "nets and samplers are made for the unit sphere. Centre and scale the clouds first."
    )
