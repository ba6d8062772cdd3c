"""The declaration of every setting of a run: its type, help, limits and what it affects.

Help, validation, resuming, the cache of task nets, sweeps, ``evaluate`` and ``report`` read it. A
new run-level setting is one field of ``RunSettings``. A setting of a group is an argument of the
class behind the group, which checks it; it has a line in ``INSIDE`` where it affects something else
than its group.
"""

from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, Literal, get_args

from mops_lightning.config.declaration import Affects, InEvaluation, Setting, Training
from mops_lightning.config.limits import ABOVE_ZERO, TRAINER, Limits, number, one_of, whole

Learn = Literal["task", "sampler", "joint", "nothing"]
LEARN = get_args(Learn)
"""The choices of ``learn``."""
WITH_SAMPLER = ("sampler", "joint", "nothing")


def setting(default: Any, text: str, affects: Affects = Affects.RESULTS, **more: Any) -> Any:
    """Return a field of ``RunSettings``; see ``Setting``."""
    return field(default=default, metadata={"setting": Setting(text, affects, **more)})


def group(affects: Affects = Affects.RESULTS, **more: Any) -> Any:
    """Return a field for a group of choices."""
    return setting(None, "", affects, group=True, **more)


def _are_sizes(value: Any) -> bool:
    """Return whether a value is ``auto`` or a list of sizes."""
    if value == "auto":
        return True
    return type(value) is list and value != [] and all(map(whole(1).fits, value))


def _are_words_or_null(value: Any) -> bool:
    if value is None:
        return True
    return type(value) is list and all(type(word) is str for word in value)


@dataclass
class RunSettings:
    """The top level of the configuration."""

    # Sizes and seeds make the rows and columns of a report, so that it does not compare them.
    m: int = setting(
        32,
        "number of sampled points; for multi-size samplers, the size reported as the score",
        Affects.SCORES,
        limits=whole(1),
        compare=False,
    )
    sizes: Any = setting(
        "auto",
        "sizes tested in addition to m: auto (the usual sizes, for multi-size samplers) or "
        "[8,100,...]",
        Affects.SCORES,
        limits=Limits("auto or a list of whole numbers of at least 1", _are_sizes),
        learn=WITH_SAMPLER,
        compare=False,
    )
    # What a run learned, its weights, data and task net are compared by fields of the record.
    learn: str = setting(
        "sampler",
        "what is trained: sampler (task net frozen), task (alone, full clouds), joint, nothing",
        Affects.TRAINING,
        limits=one_of(*LEARN),
        repeat=False,
        compare=False,
    )
    seed: int = setting(
        0,
        "seed of weights, order, augmentation and procedural data",
        limits=whole(0),
        evaluation=InEvaluation.CHANGES,  # of index samplers and procedural data
        compare=False,
    )
    weights: str | None = setting(
        "auto",
        "task net: auto (cached, else trained first), a model, a run, a weights file, its "
        "URL#sha256=HASH, or null (untrained); with learn=task the file that training starts from",
        nullable=True,
        by_content=True,
        repeat=False,
        evaluation=InEvaluation.CHANGES,
        compare=False,
    )
    pretrain_from: str | None = setting(
        None,
        "weights, as for weights=, that the training of the task net by weights=auto starts from",
        Affects.TRAINING,
        nullable=True,
        serves=Training.FIRST,
        evaluation=InEvaluation.FOR_NEW_NET,
        compare=False,
    )
    other_nets: Any = setting(
        None,
        "[NAME,...]: further frozen task nets that the sampler is trained under, models or runs",
        Affects.TRAINING,
        limits=Limits(
            "null or a list of models or runs that trained a task net", _are_words_or_null
        ),
        learn=("sampler",),
        nullable=True,
        serves=Training.SAMPLER,
        by_content=True,
        compare=False,  # the number is a part of the row's name
    )
    ckpt_path: str | None = setting(
        None,
        "resume training: last (newest run of these settings), a run folder or a .ckpt file",
        Affects.NOTHING,
        nullable=True,
        evaluation=InEvaluation.STAYS,
    )
    evaluate: str | None = setting(
        None,
        "test this run or model again, with other sizes=, dataset= or weights=; trains nothing",
        nullable=True,
        repeat=False,
        evaluation=InEvaluation.CHANGES,
        compare=False,
    )
    task_lr_scale: float = setting(
        1.0,
        "with learn=joint, the task net's learning rate as a share of the sampler's",
        Affects.TRAINING,
        limits=ABOVE_ZERO,
        learn=("joint",),
    )
    batch_size: int = setting(
        32,
        "clouds per batch",
        limits=whole(2),  # BatchNorm cannot learn from one cloud
        evaluation=InEvaluation.CHANGES,
    )
    val_fraction: float = setting(
        0.05,
        "share of the training clouds held out for the curves under val/; never trained on",
        Affects.TRAINING,
        limits=number("of at least 0 and below 1", lambda x: 0 <= x < 1),
        evaluation=InEvaluation.FOR_NEW_NET,
    )
    test_noise_std: float = setting(
        0.0,
        "standard deviation of Gaussian noise on all coordinates of test clouds (0.1 is 10 %)",
        Affects.SCORES,
        limits=number("of at least 0", lambda x: x >= 0),
    )
    test_corruption: str | None = setting(
        None,
        "corruption of test clouds and its severity, such as shear-3 (docs/data.md); null: none",
        Affects.SCORES,
        nullable=True,
    )
    tags: Any = setting(
        None,
        "[WORD,...]: words that describe the run, for report and TensorBoard",
        Affects.NOTHING,
        limits=Limits("null or a list of words", _are_words_or_null),
        nullable=True,
    )
    pictures: int = setting(
        4, "number of test clouds in the pictures; 0 for none", Affects.NOTHING, limits=whole(0)
    )
    out: str = setting(
        "outputs", "folder for runs; every run makes its own folder in it", Affects.NOTHING
    )
    cache: str = setting(
        "${oc.env:MOPS_CACHE,'~/.cache/mops_lightning'}",
        "folder for generated data and pretrained task nets, shared between runs",
        Affects.NOTHING,
    )
    epochs: Any = setting(
        None,
        "number of epochs for each value of learn; trainer.max_epochs takes its value from here",
        Affects.NOTHING,
        repeat=True,
        evaluation=InEvaluation.FOR_NEW_NET,
    )
    augment: Any = setting(
        None,
        "augmentation of training clouds: task for learn=task, sampler for sampler and joint",
        Affects.TRAINING,
        per_learn=True,
        repeat=True,
        evaluation=InEvaluation.FOR_NEW_NET,
    )
    # The recipe in force is compared by a field of the record: index samplers have no recipe.
    recipe: Any = group(
        Affects.TRAINING,
        learn=("sampler", "joint"),
        serves=Training.SAMPLER,
        repeat=False,
        compare=False,
    )
    pretrain: Any = setting(
        None,
        "optimizer with which weights=auto trains the task net, for epochs.task epochs",
        learn=WITH_SAMPLER,
        serves=Training.FIRST,
        evaluation=InEvaluation.FOR_NEW_NET,
        compare=False,
    )
    # Baselines have their own rows in reports.
    baselines: Any = group(
        Affects.SCORES,
        learn=WITH_SAMPLER,
        serves=Training.SAMPLER,  # they are tested beside learned samplers
        compare=False,
    )
    names: Any = setting(
        None, "the chosen groups' names; derived, not to be set", Affects.SCORES, compare=False
    )
    # An evaluation chooses the number of points (task.resample), another net with weights=, other
    # data, and what a sampler's training does not depend on; see ``training/as_trained.py``.
    task: Any = group(evaluation=InEvaluation.CHANGES)
    dataset: Any = group(by_content=True, evaluation=InEvaluation.CHANGES, compare=False)
    sampler: Any = group(learn=WITH_SAMPLER, evaluation=InEvaluation.CHANGES)
    optimizer: Any = group(
        Affects.TRAINING,
        serves=Training.TASK_NET | Training.JOINT | Training.SAMPLER,
        repeat=False,
    )
    trainer: Any = group(
        Affects.TRAINING, repeat=False, evaluation=InEvaluation.CHANGES, compare=False
    )
    callbacks: Any = group(
        Affects.TRAINING, repeat=False, evaluation=InEvaluation.CHANGES, compare=False
    )
    logger: Any = group(Affects.NOTHING, nullable=True)


SCHEMA: type = RunSettings
"""The declaration in use."""

_NOTHING = {"affects": Affects.NOTHING}
_STAYS = {"evaluation": InEvaluation.STAYS}
_FOR_NEW_NET = {"evaluation": InEvaluation.FOR_NEW_NET}
_OF_SAMPLED_POINTS = {"serves": Training.JOINT | Training.SAMPLER}
_OF_STAGES = {**_NOTHING, **_STAYS, "learn": ()}
"""Declarations that several settings inside groups share."""

HOW_IT_RUNS = (
    "_target_",
    "accelerator",
    "default_root_dir",
    "detect_anomaly",
    "devices",
    "enable_checkpointing",
    "enable_model_summary",
    "enable_progress_bar",
    "num_nodes",
    "num_sanity_val_steps",
    "profiler",
    "strategy",
)
"""Arguments of the trainer that change where a run works and what it shows, not its results."""
INSIDE: dict[str, dict[str, Any]] = {
    "callbacks.learning_rate": _NOTHING,
    "callbacks.checkpoint": _NOTHING,
    "callbacks.progress": _NOTHING,
    "callbacks.pictures": _NOTHING,
    # A record may come from anybody: it chooses neither addresses nor where files are written.
    "dataset.cache": {**_NOTHING, "repeat": False},
    "dataset.download": {"repeat": False},
    "sampler.m": {"compare": False},
    "sampler.m_max": {"compare": False},
    "sampler.seed": {"compare": False},
    "sampler.threshold": {"affects": Affects.SCORES},
    "task.net.sampler.m": _OF_STAGES,
    "task.net.sampler.m_max": _OF_STAGES,
    "names.stages": _NOTHING,  # the class of the stages' sampler counts
    "recipe.task_points": {"learn": None, "serves": Training.FIRST | Training.TASK_NET},
    "recipe.train_points": _OF_SAMPLED_POINTS,
    "recipe.all_points_from": _OF_SAMPLED_POINTS,
    "recipe.ema_span": _OF_SAMPLED_POINTS,
    "optimizer.lr": {"limits": ABOVE_ZERO},
    "pretrain.lr": {"limits": ABOVE_ZERO},
    # Before trainer.max_epochs, so that an error names the setting that it takes its value from.
    "epochs.task": {"limits": whole(1)},
    "epochs.sampler": {**_STAYS, "limits": whole(0)},
    "epochs.joint": {**_STAYS, "limits": whole(0)},
    "augment.sampler": _STAYS,
    "logger.flush_logs_every_n_steps": {"limits": whole(1)},
    **{f"trainer.{name}": {"limits": limits} for name, limits in TRAINER.items()},
    **{f"trainer.{name}": _NOTHING for name in HOW_IT_RUNS},
    "trainer.max_epochs": {**_STAYS, "limits": TRAINER["max_epochs"]},
    "trainer.gradient_clip_algorithm": _FOR_NEW_NET,
    "trainer.accumulate_grad_batches": {
        **_FOR_NEW_NET,
        "limits": TRAINER["accumulate_grad_batches"],
    },
    "trainer.log_every_n_steps": {**_NOTHING, "limits": TRAINER["log_every_n_steps"]},
    "trainer.strategy": {**_NOTHING, "limits": TRAINER["strategy"]},
    "trainer.limit_test_batches": {"affects": Affects.SCORES},
    "trainer.barebones": {"affects": Affects.SCORES},  # it has none
}
"""Settings inside groups: how they differ from their group."""


def declared() -> dict[str, Setting]:
    """Return the settings of the top level by name."""
    return _declared(SCHEMA)


def of(path: str) -> Setting:
    """Return the declaration of a dotted setting, or the one of the group that it is in."""
    return _of(SCHEMA, path)


def limits(path: str) -> Limits | None:
    """Return the limits of a setting; None for one without, and for one that is not declared."""
    is_declared = path in declared() or path in INSIDE
    if not is_declared:
        return None
    return of(path).limits


def _declared(schema: type) -> dict[str, Setting]:
    return {entry.name: entry.metadata["setting"] for entry in fields(schema)}


@cache
def _of(schema: type, path: str) -> Setting:
    top = path.partition(".")[0]
    declaration = _declared(schema).get(top, Setting())
    for inner, changes in INSIDE.items():
        if path == inner or path.startswith(f"{inner}."):
            # A run is evaluated with its groups as they were.
            declaration = replace(declaration, **{"repeat": declaration.repeated, **changes})
    return declaration


def register() -> None:
    """Make the declaration known to Hydra as the schema that ``conf/config.yaml`` begins with."""
    from hydra.core.config_store import ConfigStore  # the help text does without Hydra

    ConfigStore.instance().store("run_settings", SCHEMA)
