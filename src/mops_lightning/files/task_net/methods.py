"""The methods that are compared: those without weights, critical points, and trained samplers."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mops_lightning.channels import PointChannels, coordinates
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.files.task_net.subject import Subject
from mops_lightning.ops.farthest import FARTHEST
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.by_budget import MOST, rows_in_unit_sphere
from mops_lightning.samplers.critical_points import CriticalSampler
from mops_lightning.types import PointFeatureNet
from mops_lightning.zoo import names, weights
from mops_lightning.zoo.find_sampler import untrained
from mops_lightning.zoo.load import SEES_CHANNELS, load

FPS_FARTHEST = "fps_farthest"
CRITICAL = "critical"
TRAINED = "trained"

NAMES = (*names.UNTRAINED, FPS_FARTHEST, CRITICAL)
"""Methods without training of their own."""


class Method(ABC):
    """One way to choose points.

    Attributes:
        name: in the table.
    """

    name: str

    @abstractmethod
    def rows(self, clouds: Tensor, m: int, seed: int) -> Tensor:
        """Return the rows ``(B, m)`` of chosen points of clouds ``(B, N, 3 + C)``."""

    def takes(self, m: int) -> bool:
        """Return whether it chooses m points."""
        return True


class Untrained(Method):
    """A sampler without weights, by its name."""

    def __init__(self, name: str) -> None:
        self.name = name

    def rows(self, clouds: Tensor, m: int, seed: int) -> Tensor:
        """Return the rows of chosen points."""
        sampler = self.sampler(m, seed)
        return rows_in_unit_sphere(sampler, coordinates(clouds), m)

    def sampler(self, m: int, seed: int) -> Sampler:
        """Return the sampler of up to m points."""
        if self.name == FPS_FARTHEST:
            return untrained("fps", m, seed, start=FARTHEST)
        return untrained(self.name, m, seed)

    def node(self, seed: int) -> dict[str, Any]:
        """Return the sampler as plain data, as ``ByBudget`` files hold it."""
        cls = type(self.sampler(1, seed))
        node: dict[str, Any] = {
            "_target_": f"{cls.__module__}.{cls.__qualname__}",
            "m": MOST,
        }
        if self.name not in ("voxel", "serial"):
            node["seed"] = seed
        if self.name == FPS_FARTHEST:
            node["start"] = FARTHEST
        return node


class Critical(Method):
    """The points that win the maxima of the task net's features."""

    name = CRITICAL

    def __init__(self, net: Any) -> None:
        self.net = net

    def rows(self, clouds: Tensor, m: int, seed: int) -> Tensor:
        """Return the rows of chosen points."""
        sampler = CriticalSampler(m, net=self.net, seed=seed)
        return rows_in_unit_sphere(sampler, clouds, m)


class Trained(Method):
    """A trained sampler, whose completed sets are taken.

    Args:
        given: a sampler, a run, a model or a weights file.
        name: in the table.
        seen: the channels of the task net.

    Attributes:
        sampler: in evaluation mode.
        path: its weights file; None for a sampler in memory, which cannot be saved.

    Raises:
        UserError: there is no such sampler, or it sees other channels than the net.
    """

    def __init__(self, given: str | Sampler, name: str, seen: PointChannels) -> None:
        self.name = name
        self.seen = seen
        self.path: Path | None = None
        if isinstance(given, Sampler):
            self.sampler = given.eval()
        else:
            try:
                self.path = weights.of_run(names.resolve(given))
                self.sampler = load(self.path)
            except UserError as error:
                raise UserError(f"--weights: {error}") from None
        channels = self.sampler.point_channels
        if channels and channels.names != seen.names:
            own = ", ".join(channels.names)
            of_net = ", ".join(seen.names) or "none"
            raise UserError(
                f"--weights: {name} sees the channels {own}, but the task net sees {of_net}."
            )

    def takes(self, m: int) -> bool:
        """Return whether it was trained for m points."""
        if self.sampler.flexible:
            return m <= self.sampler.m
        return m == self.sampler.m

    def rows(self, clouds: Tensor, m: int, seed: int) -> Tensor:
        """Return the rows of chosen points; without any, the channels are its own or none."""
        channels = self.sampler.point_channels
        if not channels:
            return rows_in_unit_sphere(self.sampler, coordinates(clouds), m)
        values = self.seen.restored(clouds[..., 3:].double())
        own_channels = channels.scaled(values).to(clouds.dtype)
        own_clouds = torch.cat([coordinates(clouds), own_channels], -1)
        return rows_in_unit_sphere(self.sampler, own_clouds, m)

    def config(self) -> dict[str, Any]:
        """Return the settings of the run that trained it; empty for a sampler in memory."""
        if self.path is None:
            return {}
        config: dict[str, Any] = weights.read(self.path)["config"]
        return config

    def node(self) -> dict[str, Any]:
        """Return the sampler as plain data, as ``ByBudget`` files hold it."""
        node = dict(self.config()["sampler"])
        if self.sampler.point_channels:
            node[SEES_CHANNELS] = True
        return node


def methods_of(
    chosen: Sequence[str] | None,
    given: Sequence[str | Sampler],
    subject: Subject,
    sizes: Sequence[int],
) -> list[Method]:
    """Return the methods of a comparison.

    Farthest points are always among them, because the others are compared with these.

    Args:
        chosen: names among ``NAMES``; None: all that the net allows.
        given: trained samplers.
        subject: the task; the sampler that its run trained is added where none is given.
        sizes: numbers of points.

    Raises:
        UserError: a name is unknown, a sampler does not fit, or it chooses none of the sizes.
    """
    has_features = isinstance(subject.task.net, PointFeatureNet)
    known = [name for name in NAMES if name != CRITICAL or has_features]
    for name in chosen or ():
        if name == CRITICAL and not has_features:
            raise UserError(
                f"--methods: critical needs a net with features of single points under a maximum, "
                f"which {subject.name} has not."
            )
        if name not in known:
            hint = did_you_mean(name, known)
            raise UserError(f"--methods: unknown {name!r}.{hint}")
    if chosen is not None:
        wanted = {*chosen, "fps", FPS_FARTHEST}
        known = [name for name in known if name in wanted]
    methods: list[Method] = []
    for name in known:
        if name == CRITICAL:
            methods.append(Critical(subject.task.net))
        else:
            methods.append(Untrained(name))
    return methods + list(_trained(given, subject, sizes))


def _trained(
    given: Sequence[str | Sampler], subject: Subject, sizes: Sequence[int]
) -> list[Trained]:
    if not given and subject.sampler is not None:
        given = [str(subject.sampler)]
    samplers = []
    for sampler, name in zip(given, _names(given), strict=True):
        method = Trained(sampler, name, subject.channels)
        if not any(method.takes(m) for m in sizes):
            allowed = str(method.sampler.m)
            if method.sampler.flexible:
                allowed = f"up to {allowed}"
            numbers = ", ".join(map(str, sizes))
            raise UserError(f"--m: {name} was trained for {allowed} points, got {numbers}.")
        samplers.append(method)
    return samplers


def _names(given: Sequence[str | Sampler]) -> list[str]:
    """Return a name for every trained sampler: the last part of its path, or its class."""
    if len(given) == 1:
        return [TRAINED]
    short = [_short_name(sampler) for sampler in given]
    numbered = []
    for place, name in enumerate(short, start=1):
        is_unique = short.count(name) == 1 and name not in NAMES
        if not is_unique:
            name = f"{name}_{place}"
        numbered.append(name)
    return numbered


def _short_name(given: str | Sampler) -> str:
    if isinstance(given, Sampler):
        return type(given).__name__
    return Path(given).name
