"""``evaluate=RUN``: the trained run, and the settings of its evaluation.

RUN is a folder, or a model, whose header contains a record. A record may come from anybody: nothing
that names code is taken from it, and no path in place of a choice.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from mops_lightning.config import overrides, settings
from mops_lightning.config.declaration import InEvaluation
from mops_lightning.config.labels import NAMED
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
UNFINISHED = {
    "failed": "failed",
    "interrupted": "was interrupted",
    "running": "is still running or was killed",
}
"""The states of runs that are not completed, as parts of a sentence."""

NOT_OF_TASK_NETS = ("m", "weights")
"""Settings of the test of a sampler that also count in other runs of ``learn=task``."""


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
            place = names.resolve(name)
            if place.is_file() and place.suffix == model_file.SUFFIX:
                card = model_file.read_card(place)
                return cls(name, place, run_record.from_plain(card["record"]))
            if not place.is_dir():
                raise UserError(f"no folder {place}. Give a model, or the folder of a run.")
            record = run_record.read(place)
        except UserError as error:
            raise UserError(f"{KEY}: {error}") from None
        if record.status != "completed":
            hint = "Give a completed run."
            if (place / "checkpoints" / CHECKPOINT).is_file():
                hint = f"Finish it with its own command and ckpt_path={place}."
            raise UserError(f"{KEY}: {place} {UNFINISHED[record.status]}. {hint}")
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
        used = self.record.config["names"]  # a sweep's file may choose them
        chosen = []
        for name, group in NAMED.items():
            is_of_training = name == "recipe"
            if used.get(name) and not is_of_training:
                chosen.append(f"{group}={used[name]}")
        for argument in self.record.overrides:
            key = overrides.key(argument)
            is_choice = "/" in key or "@" in key
            if is_choice and is_repeated(overrides.path(argument)):
                chosen.append(overrides.readable(argument))
        for argument in chosen:
            override = overrides.parse_override(argument)
            if override is None or not NAME.fullmatch(str(override.value())):
                raise self.not_accepted(argument)
        return chosen

    def not_accepted(self, setting: str) -> UserError:
        """Return the error about a setting that no record may choose."""
        return UserError(
            f"{KEY}: the record of {self.name} sets {setting}, which is not accepted from a "
            "record. If you trust it, give it on the command line."
        )


def is_repeated(path: str) -> bool:
    """Return whether an evaluation repeats a setting of the run."""
    top = path.partition(".")[0]
    return top in settings.declared() and top != "names" and settings.of(path).repeated


def is_special(path: str) -> bool:
    """Return whether a setting is a special key such as ``_target_``, or is below one."""
    return any(part.startswith("_") for part in path.split("."))


def command_line(arguments: list[str]) -> list[str]:
    """Add a run's choices of groups to the user's if ``evaluate=RUN`` is among these.

    Args:
        arguments: flags, then settings.

    Raises:
        UserError: RUN is not a completed run that trained something.
    """
    named = [argument for argument in arguments if overrides.key(argument) == KEY]
    if not named:
        return arguments
    name = _run_named(named[-1])
    if name is None:
        return arguments
    path = Path(name).expanduser()
    trained = TrainedRun.read(str(path) if path.exists() else name)
    learn = "task" if trained.trained_task_net else "nothing"
    run = f"{KEY}={overrides.quote(trained.name)}"
    of_evaluation = [*trained.choices(), f"learn={learn}", f"weights={OF_RUN}", run]
    # The processes of one run are started with what has been added here.
    added = [*named, *of_evaluation]
    rest = [argument for argument in arguments if argument not in added]
    _check_given(rest, trained)
    paths = [overrides.path(argument) for argument in rest]
    for argument in of_evaluation:
        place = overrides.path(argument)
        is_given = any(covers(given, place) for given in paths)
        if not is_given:
            rest.append(argument)
    return rest


def _run_named(argument: str) -> str | None:
    """Return the run that ``evaluate=RUN`` names."""
    override = overrides.parse_override(argument)
    if override is None or override.is_delete():
        return None
    if override.is_sweep_override():
        raise UserError(f"{argument}: {KEY} takes one run. Start one evaluation for each.")
    value = override.value()
    if value == "":
        raise UserError(f"{argument}: no run is given. Give a run's folder or a model.")
    return None if value is None else str(value)


def _check_given(arguments: list[str], trained: TrainedRun) -> None:
    """Refuse settings of the user that do not apply to a test of this run.

    Raises:
        UserError: a setting does not apply.
    """
    used = trained.record.config["names"]
    has_new_net = "weights=auto" in arguments
    for argument in arguments:
        path = overrides.path(argument)
        if not _may_change(path, has_new_net):
            raise UserError(
                f"{argument}: has no effect with {KEY}, which trains nothing. Leave it out, or "
                f"train with the settings of {trained.name} and without {KEY}."
            )
        is_of_sampler = path in NOT_OF_TASK_NETS or not settings.of(path).counts("task")
        if trained.trained_task_net and is_of_sampler:
            raise UserError(
                f"{argument}: has no effect with {KEY}={trained.name}, which trained a task net "
                "alone. To test a sampler with it, evaluate the sampler's run with "
                f"weights={trained.name}."
            )
        if path in ("task", "sampler") and argument != f"{path}={used[path]}":
            raise UserError(
                f"{KEY}: {trained.name} was trained with {path}={used[path]}, got {argument}. "
                f"Leave {path} out, or give another run."
            )


def _may_change(path: str, has_new_net: bool) -> bool:
    """Return whether an evaluation may change a setting; unknown ones are refused later.

    Args:
        path: of the setting.
        has_new_net: whether the evaluation trains another task net.
    """
    top = path.partition(".")[0]
    if top == "experiment":  # a training of its own
        return False
    if top not in settings.declared():
        return True
    how = settings.of(path).in_evaluation
    if how is InEvaluation.FOR_NEW_NET:
        return has_new_net
    return how is InEvaluation.CHANGES


def covers(path: str, other: str) -> bool:
    """Return whether a setting is another one or contains it."""
    return other == path or other.startswith(f"{path}.")
