from collections.abc import Sequence
from inspect import Parameter
from typing import Any, Literal

import pytest
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from mops_lightning.config.build import PASSED_ON, signature
from mops_lightning.config.compose import compose
from mops_lightning.config.groups import conf_dir
from mops_lightning.config.validate import check, misfit
from mops_lightning.errors import UserError

SPECIALISED = ("task_settings", "dataset_task", "sampler_recipe")
"""Groups that the defaults list chooses from, not the user; see test_groups."""


def choices():
    """Every (group, name) that conf/ offers, as an override."""
    for path in sorted(conf_dir().rglob("*.yaml")):
        group = path.parent.relative_to(conf_dir()).as_posix()
        specialised = group in SPECIALISED or path.parent.with_suffix(".yaml").is_file()
        is_choice = group != "." and not group.startswith("hydra") and path.stem != "own"
        if is_choice and not specialised:
            yield f"{group}={path.stem}"


WITH_ROOT = (
    "meshes",
    "hdf5",
    "clouds",
    "own_scans",
    "own_scans_icp",
    "las_segmentation",
    "mesh_sequence",
)
"""Choices whose files the user must name."""
FROM_CODE = {
    *("params", "optimizer", "total_steps"),  # of optimizers and schedules
    *("net", "num_classes", "num_parts"),  # of tasks, nets and samplers
    *("m", "seed"),  # of baselines
    "channels",  # of the stages' samplers
    "point_channels",  # of samplers, nets and tasks, from the data
    *("save_dir", "checkpoint", "score", "batch", "titles", "folder"),  # of loggers and callbacks
}
"""Arguments that code gives, not YAML: see training.run.make_experiment."""


def nodes(cfg):
    if isinstance(cfg, DictConfig):
        if cfg.get("_target_") is not None:
            yield cfg
        for key in cfg:
            if not OmegaConf.is_missing(cfg, key):
                yield from nodes(cfg[key])


@pytest.mark.parametrize("override", list(choices()))
def test_compose_every_choice_fits_its_constructor(override):
    root = ["dataset.root=somewhere"] if override.endswith(WITH_ROOT) else []
    cfg = compose([override, *root])
    OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    check(cfg)
    baselines = [id(node) for node in cfg.baselines.values()]
    for node in nodes(cfg):
        parameters = signature(node["_target_"], override)
        given = {key for key in node if not str(key).startswith("_")} - {"schedule"}
        assert given <= set(parameters), node["_target_"]
        passes_on = node["_target_"] in PASSED_ON  # the arguments of a class of Lightning's
        own = node["_target_"].startswith("mops_lightning.") and not passes_on
        several = (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL)
        named = {name: p for name, p in parameters.items() if p.kind not in several}
        named = {name: p for name, p in named.items() if own or p.default is p.empty}
        missing = set(named) - given - FROM_CODE
        missing -= {"start"} if id(node) in baselines else set()
        assert not missing, f"{node['_target_']}: no file shows {missing}"


def test_rates_of_rival_samplers_fall_at_the_published_number_of_clouds():
    cfg = compose(["experiment=classification_snet", "sampler=samplenet"])
    assert cfg.optimizer.schedule.every * cfg.batch_size == 600_000


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["sampler=mops", "sampler.alpha=nan"], "sampler.alpha must be finite .*, got nan"),
        (["task_lr_scale=inf"], "task_lr_scale must be .*got inf"),
        (["+optimizer.eps=1e400"], "optimizer.eps must be finite .*, got inf"),
        (["+optimizer.betas=[nan,1]"], "optimizer.betas must be finite .*, got nan"),
        (["seed=18446744073709551616"], r"seed must be finite and below 2\*\*63, got 1844"),
        (["m=0"], "m must be a whole number of at least 1, got 0"),
        (
            ["sampler=fmops", "sampler.num_sizes=1.5"],
            "sampler.num_sizes must be a whole number, got 1.5",
        ),
        (["sampler=snet", "sampler.head_channels=[a]"], "a list, each of it a whole number"),
        (["sizes=[8,x]"], "sizes must be auto or a list of whole numbers"),
        (["weights=run"], "weights=run means the run named by evaluate"),
        (["optimizer.schedule=3"], "optimizer.schedule must be settings, got 3"),
        (["+epochs.foo=1"], "epochs.foo: no such setting"),
        (["epochs.task=???"], "^epochs.task must be set: try epochs.task=NUMBER"),
        (["augment.sampler=3"], "augment has settings of task and sampler, got sampler: 3"),
        (["+augment.all=1"], "augment has settings of task and sampler, got all: 1"),
        (["+augment.task.jiter=0"], "Did you mean 'jitter'"),
        (["augment.task.jitter=-1"], r"augment\.task\.jitter must be at least 0"),
        (["+augment.sampler.jitter=null"], r"sampler\.jitter must be a number, got None"),
        (["augment.task.rotate_up=3"], "rotate_up must be true or false or a text, got 3"),
        (["pretrain=foo"], "pretrain must be settings, got 'foo'"),
        (["learn=smapler"], "Did you mean 'sampler'"),
        (["+sampler.alhpa=3"], "Did you mean 'alpha'"),
        (["+bacth_size=3"], "Did you mean 'batch_size'"),
        (["epochs.task=0"], "^epochs.task must be a whole number of at least 1"),
        (["epochs=3"], "^epochs must be settings, got 3"),
        (["+callbacks.early=3"], "callbacks.early must be null or settings .*, got 3"),
        (["baselines.fps=3"], "baselines.fps must be null or settings .*, got 3"),
        (["~weights"], "weights cannot be removed"),
        (["batch_size=1"], "batch_size must be a whole number of at least 2"),
        (["+sampler.alpha.x=3"], r"sampler\.alpha must be a number, got {'x': 3}"),
        (["+trainer.gradient_clip_val=-1"], "gradient_clip_val must be null or a number above 0"),
        (["+trainer.accumulate_grad_batches=0"], "accumulate_grad_batches must be a whole number"),
        (["logger=csv", "+logger.flush_logs_every_n_steps=0"], "n_steps must be a whole number"),
        (["+trainer.max_steps=0"], "trainer.max_steps must be -1 or .*at least 1, got 0"),
        (["+trainer.deterministic=foo"], "deterministic must be true, false or warn, got .foo"),
        (["trainer.max_epochs=-1"], "max_epochs=-1 needs trainer.max_steps"),
        (["trainer.max_epochs=-1", "+trainer.max_time=00:08:00:00"], "needs trainer.max_steps"),
        (["trainer.max_epochs=-2"], "max_epochs must be -1 or a whole number"),
        (["+trainer.max_time=0"], "trainer.max_time must be null or a time, .*got 0"),
        (["+trainer.min_epochs=99"], "min_epochs must be at most trainer.max_epochs=10, got 99"),
        (["+trainer.log_every_n_steps=0"], "log_every_n_steps must be a whole number"),
        (["+trainer.logger=false"], "trainer.logger must be left out; give logger=NAME"),
        (["tags=abc"], "tags must be null or a list of words, got .abc"),
        (["optimizer.lr=0"], "optimizer.lr must be a number above 0, got 0"),
        (["trainer.max_epochs=0"], "trainer.max_epochs must be a whole number"),
        (["val_fraction=1.0"], "val_fraction must be .* below 1, got 1.0"),
        (["cache=null"], "cache must be a text, got None"),
        (["task_lr_scale=0", "learn=joint"], "task_lr_scale must be a number above 0"),
        (["test_corruption=sheer-3"], "test_corruption must be a kind .*Did you mean 'shear'"),
        (["test_noise_std=inf"], "test_noise_std must be a number of at least 0"),
        (["dataset=meshes"], "dataset.root must be set"),
        (["dataset=hdf5", "dataset.root=nan"], "dataset.root must be a text, got nan"),
        (["sampler=own"], "sampler._target_ must be set: give sampler._target_=MODULE.CLASS"),
        (["sampler._target_=mops_lightning.samplers.mops.MOPSNett"], "cannot import"),
        (["sampler._target_=mops_lightning"], "'mops_lightning' is neither a class nor a function"),
    ],
)
def test_check_mistake_names_setting(overrides, said):
    with pytest.raises(UserError, match=said):
        check(compose(overrides))


@pytest.mark.parametrize(
    ("annotation", "fitting", "misfitting", "wanted"),
    [
        (int, [3, -1], [1.5, True, None, "3", [3]], "a whole number"),
        (float, [3, 0.5], [True, None, "x"], "a number"),
        (bool, [True], [1, None, "true"], "true or false"),
        (str, ["x"], [3, None], "a text"),
        (int | None, [3, None], [1.5, "x"], "a whole number or null"),
        (float | Tensor, [0.1, 3], ["x"], "a number"),
        (Sequence[int], [[1, 2], []], [[1.5], ["a"]], "a list, each of it a whole number"),
        (list[str] | None, [["a"], None], ["a", 3], "a list or null"),
        (tuple[float, float], [[0.9, 0.99]], [0.9], "a list"),
        (Literal["sum", "mean"], ["sum", "typo"], [3, None], "a text"),
        (Any, [3, None, "x", [1]], [], ""),
    ],
)
def test_values_are_compared_with_annotations(annotation, fitting, misfitting, wanted):
    assert [misfit(value, annotation) for value in fitting] == [None] * len(fitting)
    assert [misfit(value, annotation) for value in misfitting] == [wanted] * len(misfitting)
