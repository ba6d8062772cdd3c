"""The declaration of every setting of a run: its type, help, limits and what it affects.

Help, validation, resuming, the cache of pretrained task nets, sweeps, ``evaluate`` and ``report``
read it. A new setting is one field of ``RunSettings``; one inside a group that differs from its
group is one line of ``inside.INSIDE``.
"""

import textwrap
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, get_args, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from mops_lightning.config.annotations import describe
from mops_lightning.config.declaration import (
    Affects,
    Limits,
    Setting,
    about,
    group,
    number,
    one_of,
    table,
    whole,
)
from mops_lightning.config.inside import INSIDE
from mops_lightning.errors import UserError, did_you_mean
from mops_lightning.types import Learn

WITH_SAMPLER = ("sampler", "joint", "nothing")
NAME = "run_settings"
"""What the schema is called in the defaults list of ``conf/config.yaml``."""


SIZES = Limits(
    "auto or a list of whole numbers of at least 1",
    lambda x: (
        x == "auto"
        or (isinstance(x, list) and bool(x) and all(type(m) is int and m >= 1 for m in x))
    ),
)


@dataclass
class RunSettings:
    """The top level of the configuration."""

    # Sizes and seeds make the rows and columns of a report, so that it does not compare them.
    m: int = field(
        default=32,
        metadata=about(
            "points that the sampler returns; for a net of many sizes, the size that is shown",
            Affects.SCORES,
            limits=whole(1),
            compare=False,
        ),
    )
    sizes: Any = field(
        default="auto",
        metadata=about(
            "sizes tested in addition to m: auto (the usual sizes for a net of many sizes) or "
            "[8,100,...]",
            Affects.SCORES,
            limits=SIZES,
            compare=False,
        ),
    )
    # What a run learned, its weights, data and task net are compared by the record's notes.
    learn: str = field(
        default="sampler",
        metadata=about(
            "what is trained: sampler (task net frozen), task (alone, full clouds), joint, nothing",
            Affects.TRAINING,
            limits=one_of(*get_args(Learn)),
            repeat=False,
            compare=False,
        ),
    )
    seed: int = field(
        default=0,
        metadata=about(
            "seed of weights, order, augmentation and procedural data",
            limits=whole(0),
            compare=False,
        ),
    )
    weights: str | None = field(
        default="auto",
        metadata=about(
            "task net: auto (cached, else trained first), a model, a run, a weights file, or null "
            "(untrained); with learn=task the file that training starts from",
            nullable=True,
            by_content=True,
            repeat=False,
            compare=False,
        ),
    )
    ckpt_path: str | None = field(
        default=None,
        metadata=about(
            "resume training: last (newest run of these settings), a run folder or a .ckpt file",
            Affects.NOTHING,
            nullable=True,
        ),
    )
    evaluate: str | None = field(
        default=None,
        metadata=about(
            "test this run or model again, with other sizes=, dataset= or weights=; trains nothing",
            nullable=True,
            repeat=False,
            compare=False,
        ),
    )
    task_lr_scale: float = field(
        default=1.0,
        metadata=about(
            "with learn=joint, the task net's learning rate as a share of the sampler's",
            Affects.TRAINING,
            limits=number("above 0", lambda x: x > 0),
            learn=("joint",),
        ),
    )
    batch_size: int = field(
        default=32,
        metadata=about(
            "clouds per batch",
            limits=whole(2),  # BatchNorm cannot learn from one cloud
        ),
    )
    val_fraction: float = field(
        default=0.05,
        metadata=about(
            "share of the training clouds held out for the curves under val/; never trained on",
            Affects.TRAINING,
            limits=number("of at least 0 and below 1", lambda x: 0 <= x < 1),
        ),
    )
    test_noise_std: float = field(
        default=0.0,
        metadata=about(
            "standard deviation of Gaussian noise on all coordinates of test clouds (0.1 is 10 %)",
            Affects.SCORES,
            limits=number("of at least 0", lambda x: x >= 0),
        ),
    )
    refine: int = field(
        default=0,
        metadata=about(
            "passes of exchanges that improve the tested points by asking the task net (readout "
            "refined; slow); 0 leaves it out",
            Affects.SCORES,
            limits=whole(0),
            learn=WITH_SAMPLER,
            compare=False,  # its results have rows of their own
        ),
    )
    pictures: int = field(
        default=4,
        metadata=about(
            "number of test clouds in the pictures; 0 for none", Affects.NOTHING, limits=whole(0)
        ),
    )
    out: str = field(
        default="outputs",
        metadata=about(
            "folder for runs; every run makes a folder of its own below it",
            Affects.NOTHING,
        ),
    )
    cache: str = field(
        default="${oc.env:MOPS_CACHE,'~/.cache/mops_lightning'}",
        metadata=about(
            "folder for generated data and pretrained task nets, shared between runs",
            Affects.NOTHING,
        ),
    )
    epochs: Any = field(
        default=None,
        metadata=table(
            "default number of epochs: task for learn=task, sampler for sampler and joint"
        ),
    )
    augment: Any = field(
        default=None,
        metadata=about(
            "augmentation of training clouds: task for learn=task, sampler for sampler and joint",
            Affects.TRAINING,
            per_learn=True,
            repeat=True,
        ),
    )
    recipe: Any = field(
        default=None,
        # What was in force is compared by the record's notes: index samplers have no recipe.
        metadata=group(Affects.TRAINING, learn=("sampler", "joint"), repeat=False, compare=False),
    )
    pretrain: Any = field(
        default=None,
        metadata=about(
            "optimizer with which weights=auto trains the task net, for epochs.task epochs",
            learn=WITH_SAMPLER,
            compare=False,
        ),
    )
    baselines: Any = field(
        default=None,
        metadata=group(
            Affects.SCORES,
            learn=WITH_SAMPLER,
            compare=False,  # they have rows of their own
        ),
    )
    names: Any = field(
        default=None,
        metadata=about(
            "the chosen groups' names; derived, not to be set", Affects.SCORES, compare=False
        ),
    )
    task: Any = field(default=None, metadata=group())
    dataset: Any = field(default=None, metadata=group(by_content=True, compare=False))
    sampler: Any = field(default=None, metadata=group(learn=WITH_SAMPLER))
    optimizer: Any = field(default=None, metadata=group(Affects.TRAINING, repeat=False))
    trainer: Any = field(
        default=None, metadata=group(Affects.TRAINING, repeat=False, compare=False)
    )
    callbacks: Any = field(
        default=None,
        metadata=group(Affects.TRAINING, nullable=True, repeat=False, compare=False),
    )
    logger: Any = field(default=None, metadata=group(Affects.NOTHING, nullable=True))


SCHEMA: type = RunSettings
"""The declaration in use."""

ON_DEMAND: dict[str, Setting] = {
    "models.path": Setting(
        "folders with models of your own, searched before those of MOPS_MODELS",
        Affects.NOTHING,
        limits=Limits("a text", lambda x: isinstance(x, str)),
    ),
}
"""Settings that a configuration contains only where the command line gives them."""


def declared() -> dict[str, Setting]:
    """Return the settings of the top level by name."""
    return {one.name: one.metadata["setting"] for one in fields(SCHEMA)}


def of(path: str) -> Setting:
    """Return the declaration of a dotted setting, or the one of the group that it is in."""
    return _of(SCHEMA, path)


@cache
def _of(schema: type, path: str) -> Setting:
    top = {one.name: one.metadata["setting"] for one in fields(schema)}
    found = ON_DEMAND.get(path) or {**ON_DEMAND, **top}.get(path.partition(".")[0], Setting())
    for inner, changes in INSIDE.items():
        if path == inner or path.startswith(f"{inner}."):
            # A run is evaluated with its groups as they were.
            found = replace(found, **{"repeat": found.repeated, **changes})
    return found


def limited() -> dict[str, Limits]:
    """Return the limits of all settings that have some, by dotted name."""
    names = [*declared(), *ON_DEMAND, *INSIDE]
    found = {name: of(name).limits for name in names}
    return {name: limits for name, limits in found.items() if limits is not None}


def refusal(path: str, value: Any) -> UserError:
    """Return the error about a value that does not fit a setting's type or limits."""
    limits = of(path).limits
    allowed = limits.allowed if limits else describe(get_type_hints(SCHEMA).get(path, Any))
    near = did_you_mean(str(value), limits.choices) if limits and limits.choices else ""
    return UserError(f"{path} must be {allowed}, got {value!r}.{near.partition(' Allowed:')[0]}")


def help_lines() -> str:
    """Return the run-level keys with their texts, for ``--help``."""
    shown = {name: one for name, one in declared().items() if not one.group} | ON_DEMAND
    width = max(map(len, shown)) + 2
    return "\n".join(
        textwrap.fill(
            one.help, 100, initial_indent=f"{name:<{width}}", subsequent_indent=" " * width
        )
        for name, one in shown.items()
    )


def register() -> None:
    """Make the declaration known to Hydra: as a schema, and as text for the help."""
    ConfigStore.instance().store(NAME, SCHEMA)
    OmegaConf.register_new_resolver("run_level_keys", help_lines, replace=True)


register()
