"""``evaluate=RUN``: the trained run, and the settings of its evaluation.

RUN is a folder, or a model, whose header contains a record. A record may come from anybody: nothing
that names code is taken from it, and no path in place of a choice.
"""

import re
from collections.abc import Iterator
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

EVALUATE = "evaluate"
OF_RUN = "run"
"""``weights=run``: the task net that the evaluated run was trained with."""
PLAIN_NAME = re.compile(r"[A-Za-z0-9_-]+")
"""A choice of a group, or a part of a setting's name."""
UNFINISHED = {
    "failed": "failed",
    "interrupted": "was interrupted",
    "running": "is still running or was killed",
}
"""The states of runs that are not completed, as parts of a sentence."""

NOT_OF_TASK_NETS = ("m", "weights")
"""Settings of the test of a sampler that also count in other runs of ``learn=task``."""


def names_a_net(weights: str | None) -> bool:
    """Return whether a value of ``weights`` names a net: a model, a run or a file."""
    return weights not in (None, "auto", OF_RUN)


@dataclass(frozen=True)
class TrainedRun:
    """A completed run that trained something, or a model.

    Attributes:
        name: as the user gave it.
        path: the run's folder, or the model's file.
        record: its record.
    """

    name: str
    path: Path
    record: RunRecord

    @classmethod
    def read(cls, name: str) -> "TrainedRun":
        """Read the record of a run or model.

        Raises:
            UserError: there is none, or it is not the record of a completed run with weights.
        """
        name = name.removesuffix(f"/{run_record.FILE}")
        try:
            path = names.resolve(name)
            if path.is_file() and path.suffix == model_file.SUFFIX:
                card = model_file.read_card(path)
                return cls(name, path, run_record.from_plain(card["record"]))
            if not path.is_dir():
                raise UserError(f"no folder {path}. Give a model, or the folder of a run.")
            record = run_record.read(path)
        except UserError as error:
            raise UserError(f"{EVALUATE}: {error}") from None
        _check_usable(record, path)
        return cls(name, path, record)

    @property
    def trained_task_net(self) -> bool:
        """Whether it trained a task net alone."""
        return bool(self.record.config["learn"] == "task")

    def choices(self) -> list[str]:
        """Return the choices of groups that it was composed from, as overrides.

        Raises:
            UserError: the record chooses a file by a path.
        """
        choices = [*self._named_choices(), *self._choices_on_command_line()]
        for argument in choices:
            override = overrides.parse_override(argument)
            if override is None or not PLAIN_NAME.fullmatch(str(override.value())):
                raise self.not_accepted(argument)
        return choices

    def _named_choices(self) -> Iterator[str]:
        """Yield the choices in ``names``, which a sweep's file may have made."""
        chosen = self.record.config["names"]
        for name, group in NAMED.items():
            is_of_training = name == "recipe"
            if chosen.get(name) and not is_of_training:
                yield f"{group}={chosen[name]}"

    def _choices_on_command_line(self) -> Iterator[str]:
        """Yield the choices that its user made in other groups, such as ``task/net``."""
        for argument in self.record.overrides:
            key = overrides.key(argument)
            is_choice = "/" in key or "@" in key
            if is_choice and is_repeated(overrides.path(argument)):
                yield overrides.readable(argument)

    def not_accepted(self, setting: str) -> UserError:
        """Return the error about a setting that no record may choose."""
        return UserError(
            f"{EVALUATE}: the record of {self.name} sets {setting}, which is not accepted from a "
            "record. If you trust it, give it on the command line."
        )


def _check_usable(record: RunRecord, folder: Path) -> None:
    """Refuse a run that is not completed, or that has no weights.

    Raises:
        UserError: the run is such a one.
    """
    if record.status != "completed":
        hint = "Give a completed run."
        if (folder / "checkpoints" / CHECKPOINT).is_file():
            hint = f"Finish it with its own command and ckpt_path={folder}."
        raise UserError(f"{EVALUATE}: {folder} {UNFINISHED[record.status]}. {hint}")
    if "weights" not in record.files:
        raise UserError(
            f"{EVALUATE}: {folder} trained nothing, or its weights were not kept; "
            "run its own command with other settings."
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
    namings = [argument for argument in arguments if overrides.key(argument) == EVALUATE]
    if not namings:
        return arguments
    name = _run_named(namings[-1])
    if name is None:
        return arguments
    path = Path(name).expanduser()
    if path.exists():
        name = str(path)
    trained = TrainedRun.read(name)
    of_run = _settings_of_run(trained)
    # A process that is started by another one of its run is given the settings of the run, too.
    not_of_user = [*namings, *of_run]
    of_user = [argument for argument in arguments if argument not in not_of_user]
    _check_given(of_user, trained)
    changed = [overrides.path(argument) for argument in of_user]
    kept = []
    for argument in of_run:
        setting = overrides.path(argument)
        if not any(covers(given, setting) for given in changed):
            kept.append(argument)
    return [*of_user, *kept]


def _settings_of_run(trained: TrainedRun) -> list[str]:
    """Return the overrides that make a command line an evaluation of a run."""
    learn = "nothing"
    if trained.trained_task_net:
        learn = "task"
    return [
        *trained.choices(),
        f"learn={learn}",
        f"weights={OF_RUN}",
        f"{EVALUATE}={overrides.quote(trained.name)}",
    ]


def _run_named(argument: str) -> str | None:
    """Return the run that ``evaluate=RUN`` names."""
    override = overrides.parse_override(argument)
    if override is None or override.is_delete():
        return None
    if override.is_sweep_override():
        raise UserError(f"{argument}: {EVALUATE} takes one run. Start one evaluation for each.")
    value = override.value()
    if value == "":
        raise UserError(f"{argument}: no run is given. Give a run's folder or a model.")
    if value is None:
        return None
    return str(value)


def _check_given(arguments: list[str], trained: TrainedRun) -> None:
    """Refuse settings of the user that do not apply to a test of this run.

    Raises:
        UserError: a setting does not apply.
    """
    chosen = trained.record.config["names"]
    has_new_net = "weights=auto" in arguments
    for argument in arguments:
        path = overrides.path(argument)
        if not _may_change(path, has_new_net):
            raise UserError(
                f"{argument}: has no effect with {EVALUATE}, which trains nothing. "
                f"Leave it out, or train with the settings of {trained.name} "
                f"and without {EVALUATE}."
            )
        is_of_sampler = path in NOT_OF_TASK_NETS or not settings.of(path).counts("task")
        if trained.trained_task_net and is_of_sampler:
            raise UserError(
                f"{argument}: has no effect with {EVALUATE}={trained.name}, "
                "which trained a task net alone. To test a sampler with it, evaluate the "
                f"sampler's run with weights={trained.name}."
            )
        if path in ("task", "sampler") and argument != f"{path}={chosen[path]}":
            raise UserError(
                f"{EVALUATE}: {trained.name} was trained with {path}={chosen[path]}, "
                f"got {argument}. Leave {path} out, or give another run."
            )


def _may_change(path: str, has_new_net: bool) -> bool:
    """Return whether an evaluation may change a setting; unknown ones are refused later.

    Args:
        path: dotted path of the setting.
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
