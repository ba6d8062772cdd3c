"""The run that ``evaluate=RUN`` tests, and the group choices that it was composed from.

RUN is a folder, or a model, whose header contains a record. A record may come from anybody: nothing
that names code is taken from it, and no path in place of a choice.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from mops_lightning.config import overrides, settings
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.checkpoint import CHECKPOINT
from mops_lightning.zoo import model_file, names

KEY = "evaluate"
OF_RUN = "run"
"""``weights=run``: the task net that the evaluated run was trained with."""
NAME = re.compile(r"[A-Za-z0-9_-]+")
"""A choice of a group, or a part of a setting's name."""


@dataclass(frozen=True)
class TrainedRun:
    """A completed run that trained something, or a model.

    Attributes:
        name: as the user gave it.
        place: the run's folder, or the model's file.
        record: its record.
    """

    name: str
    place: Path
    record: RunRecord

    @classmethod
    def read(cls, name: str) -> "TrainedRun":
        """Read the record of a run or model.

        Raises:
            UserError: there is none, or it is not the record of a completed run with weights.
        """
        name = name.removesuffix(f"/{run_record.FILE}")
        try:
            place = _place(name)
            if place.is_file():
                return cls(
                    name, place, run_record.from_plain(model_file.read_card(place)["record"])
                )
            record = run_record.read(place)
        except UserError as error:
            raise UserError(f"{KEY}: {error}") from None
        if record.status != "completed":
            hint = "Give a completed run."
            if (place / "checkpoints" / CHECKPOINT).is_file():
                hint = f"Finish it with its own command and ckpt_path={place}."
            state = {"failed": "failed", "running": "is still running or was killed"}
            raise UserError(f"{KEY}: {place} {state.get(record.status, 'was interrupted')}. {hint}")
        if "weights" not in record.files:
            raise UserError(
                f"{KEY}: {place} trained nothing, or its weights were not kept; "
                "run its own command with other settings."
            )
        return cls(name, place, record)

    @property
    def trained_task_net(self) -> bool:
        """Whether it trained a task net alone."""
        return bool(self.record.config["learn"] == "task")

    def choices(self) -> list[str]:
        """Return the choices of groups that it was composed from, as overrides.

        Raises:
            UserError: the record chooses a file by a path.
        """
        used = self.record.config["names"]
        groups = {group: used[group] for group in ("task", "dataset", "sampler")}
        chosen = [f"{group}={choice}" for group, choice in groups.items()]
        for argument in self.record.overrides:
            key = overrides.key(argument)
            if ("/" in key or "@" in key) and _is_repeated(argument):
                chosen.append(overrides.readable(argument))
        for argument in chosen:
            override = overrides.parse(argument)
            if override is None or not NAME.fullmatch(str(override.value())):
                raise self.not_accepted(argument)
        return chosen

    def check_classes(self, paths: list[str]) -> None:
        """Refuse a run whose command line named classes, unless the user names them, too.

        Args:
            paths: of the settings on the user's command line.

        Raises:
            UserError: an override of the record has a key such as ``_target_``.
        """
        for argument in self.record.overrides:
            path = overrides.path(argument)
            special = any(part.startswith("_") for part in path.split("."))
            if special and _is_repeated(argument) and path not in paths:
                raise self.not_accepted(argument)

    def not_accepted(self, setting: str) -> UserError:
        """Return the error about a setting that no record may choose."""
        return UserError(
            f"{KEY}: the record of {self.name} sets {setting}, which is not accepted from a "
            "record. If you trust it, give it on the command line."
        )


def _is_repeated(argument: str) -> bool:
    path = overrides.path(argument)
    return path.partition(".")[0] in settings.declared() and settings.of(path).repeated


def _place(run: str) -> Path:
    """Return the folder or the model file that ``evaluate=RUN`` means."""
    path = names.resolve(run)
    if not path.is_dir() and not (path.is_file() and path.suffix == model_file.SUFFIX):
        raise UserError(
            f"no folder {path}. Give a model, or the folder of a run, with result.json."
        )
    return path
