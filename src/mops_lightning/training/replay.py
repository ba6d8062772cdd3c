"""The command line of ``evaluate=RUN``: RUN's overrides, then the user's.

RUN is a folder, or a model, whose card contains a record. A record may come from anybody. Only
settings that this program declares are taken from it, and only plain values: nothing that names
code or a file of Hydra's.
"""

import re
from pathlib import Path
from typing import Any

from mops_lightning.config import overrides, settings
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.checkpoint import CHECKPOINT
from mops_lightning.zoo import model_file, names

KEY = "evaluate"
OF_RUN = "run"
"""``weights=run``: the task net that the evaluated run was trained with."""
OF_SAMPLER = (
    *("optimizer", "task_lr_scale", "recipe", "trainer.max_epochs", "epochs.sampler"),
    "augment.sampler",
)
"""Settings of the training of a sampler."""
OF_TRAINING = (
    *OF_SAMPLER,
    *("pretrain", "val_fraction", "augment", "epochs", "ckpt_path", "trainer.gradient_clip_val"),
    *("trainer.gradient_clip_algorithm", "trainer.accumulate_grad_batches"),
)
"""Settings of any training."""
NAME = re.compile(r"[A-Za-z0-9_-]+")
"""What a choice of a group may be called; a path could lead out of conf/."""


def command_line(arguments: list[str]) -> list[str]:
    """Insert a run's overrides before the user's if ``evaluate=RUN`` is among these.

    Args:
        arguments: as typed, without the program's name.

    Returns:
        The arguments for Hydra.

    Raises:
        UserError: RUN is not a completed run that trained something.
    """
    places = [i for i, a in enumerate(arguments) if overrides.key(a) == KEY]
    chosen = _chosen(arguments[places[-1]]) if places else None
    if not chosen:
        return arguments
    path = Path(chosen).expanduser()
    folder = str(path) if path.exists() else chosen
    record = trained_run(folder)
    chosen_groups = record.config["names"]
    _refuse_without_effect(arguments, folder, record.config["learn"])
    groups = {key: chosen_groups[key] for key in ("task", "dataset", "sampler")}
    typed = [a for i, a in enumerate(arguments) if i not in places and overrides.key(a)]
    # Choosing the run's own group again changes nothing; the settings below it stay too.
    typed_keys = [
        overrides.key(a) for a in typed if a not in [f"{k}={v}" for k, v in groups.items()]
    ]
    earlier = [overrides.repeatable(a) for a in record.overrides if overrides.key(a) not in groups]
    earlier = [f"{group}={name}" for group, name in groups.items()] + earlier
    kept = [
        a
        for a in earlier
        if _is_repeated(overrides.path(a))
        and not any(_covers(key, overrides.key(a)) for key in typed_keys)
    ]
    for argument in kept:
        _check_recorded(argument, folder)
    _data_are_here(kept, folder)
    learn = "task" if record.config["learn"] == "task" else "nothing"
    own = [*kept, f"learn={learn}", f"weights={OF_RUN}", f"{KEY}={overrides.quote(folder)}"]
    # All in one place: argparse accepts flags before or after all overrides, not between them.
    before = [a for i, a in enumerate(arguments[: places[0]]) if i not in places]
    behind = [a for i, a in enumerate(arguments) if i > places[0] and i not in places]
    given = {overrides.key(a) for a in typed}
    defaults = [a for a in own if overrides.key(a) not in given]
    return [*before, *defaults, *behind]


def _chosen(argument: str) -> str | None:
    """Return the run that ``evaluate=RUN`` names."""
    override = overrides.parse(argument)
    if override is None or override.is_delete():
        return None
    if override.is_sweep_override():
        raise UserError(f"{argument}: {KEY} takes one run. Start one evaluation for each.")
    value = override.value()
    if value == "":
        raise UserError(
            f"{argument}: no run is given. Give a run's folder or a model, or leave it out."
        )
    return None if value is None else str(value)


def _refuse_without_effect(arguments: list[str], folder: str, learn: str) -> None:
    """Refuse settings of a training, and of a sampler where a task net is evaluated alone.

    Raises:
        UserError: there is one.
    """
    # weights=auto may train a task net, with settings of its own.
    inert = OF_SAMPLER if "weights=auto" in arguments else OF_TRAINING
    for argument in arguments:
        path = overrides.path(argument)
        if any(path == one or path.startswith(f"{one}.") for one in inert):
            raise UserError(
                f"{argument}: has no effect with {KEY}, which trains nothing. Leave it out, or "
                f"train with the settings of {folder} and without {KEY}."
            )
        if learn == "task" and path.partition(".")[0] == "sampler":
            raise UserError(
                f"{argument}: has no effect with {KEY}={folder}, which trained a task net alone. "
                f"To test a sampler with it, evaluate the sampler's run with weights={folder}."
            )


def _data_are_here(kept: list[str], folder: str) -> None:
    """Reject a relative data folder that does not exist from the current folder."""
    for argument in kept:
        override = overrides.parse(argument)
        if override is None or overrides.key(argument) != "dataset.root" or not override.value():
            continue
        if not Path(str(override.value())).expanduser().exists():
            raise UserError(
                f"{KEY}: {folder} used {argument}, which does not exist from the current folder. "
                "Give dataset.root=PATH."
            )


def _is_repeated(path: str) -> bool:
    """Return whether an override of this dotted path is taken from a record; never Hydra's own."""
    top = path.partition(".")[0]
    known = top in settings.declared() or top == "experiment"
    return known and settings.of(path).repeated


def _check_recorded(argument: str, folder: str) -> None:
    """Reject an override of a record that could run code.

    Raises:
        UserError: the override chooses a file by a path, or its key or value holds a ``_target_``
            or an interpolation.
    """
    override = overrides.parse(argument)
    value = None if override is None or override.is_delete() else override.value()
    key = overrides.key(argument)
    declared = settings.declared().get(key)
    is_group = "/" in key or "@" in key or key == "experiment" or (declared and declared.group)
    choices = value if isinstance(value, list) else [value] if value else []
    if (
        override is None
        or override.is_sweep_override()
        or any(part.startswith("_") for part in re.split(r"[.@/]", key))
        or names_code(value)
        or (is_group and not all(NAME.fullmatch(str(one)) for one in choices))
    ):
        raise UserError(
            f"{KEY}: the record of {folder} sets {argument}, which is not accepted from a record. "
            "If you trust it, give it on the command line."
        )


def names_code(value: Any) -> bool:
    """Return whether a value holds a special key such as ``_target_``, or an interpolation."""
    if isinstance(value, dict):
        return any(str(key).startswith("_") or names_code(one) for key, one in value.items())
    if isinstance(value, list):
        return any(map(names_code, value))
    return "${" in str(value)


def place(run: str) -> Path:
    """Return the folder or the model file that ``evaluate=RUN`` means.

    Raises:
        UserError: there is none.
    """
    try:
        path = names.resolve(run)
    except UserError as error:
        raise UserError(f"{KEY}: {error}") from None
    if path.name == run_record.FILE:
        path = path.parent
    if not path.is_dir() and not (path.is_file() and path.suffix == model_file.SUFFIX):
        raise UserError(
            f"{KEY}: no folder {path}. Give a model, or the folder of a run, with result.json."
        )
    return path


def trained_run(run: str) -> RunRecord:
    """Return the record of a completed run that trained something, or of a model.

    Raises:
        UserError: it is not such a run.
    """
    folder = place(run)
    try:
        if folder.is_file():
            return run_record.from_plain(model_file.read_card(folder)["record"])
        record = run_record.read(folder)
    except UserError as error:
        raise UserError(f"{KEY}: {error}") from None
    if record.status != "completed":
        hint = "Give a completed run."
        if (folder / "checkpoints" / CHECKPOINT).is_file():
            hint = f"Finish it with its own command and ckpt_path={folder}."
        state = {"failed": "failed", "running": "is still running or was killed"}
        raise UserError(f"{KEY}: {folder} {state.get(record.status, 'was interrupted')}. {hint}")
    if "weights" not in record.files:
        raise UserError(
            f"{KEY}: {folder} trained nothing, or its weights were not kept; "
            "run its own command with other settings."
        )
    return record


def _covers(key: str, other: str) -> bool:
    """Return whether overriding ``key`` cancels an earlier override of ``other``."""
    return other == key or other.startswith((f"{key}.", f"{key}/", f"{key.replace('/', '.')}."))
