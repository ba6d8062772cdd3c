"""The settings that ``evaluate=RUN`` takes from RUN's record, and those that it refuses to take."""

import copy
import json
from functools import cache, reduce
from operator import getitem
from typing import Any

import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.config.overrides import readable
from mops_lightning.errors import UserError
from mops_lightning.training.as_trained import as_trained, lost_baselines
from mops_lightning.training.evaluation import TrainedRun, command_line
from mops_lightning.training.run import run as running
from tests.support.command_line import TINY
from tests.support.records import record

OVERRIDES = [*TINY, "sampler=fmops", "sampler.m_max=32"]


@cache
def composed(*overrides):
    return OmegaConf.to_container(compose(list(overrides)), resolve=True)


def write_run(folder, overrides=OVERRIDES, changes=None, more=()):
    """Write the record of a completed run; only the record is read here."""
    folder.mkdir()
    config: Any = copy.deepcopy(composed(*overrides))
    for path, value in (changes or {}).items():
        *nodes, name = path.split(".")
        reduce(getitem, nodes, config)[name] = value
    made = record(config, overrides=[*overrides, *more], files={"weights": "weights.safetensors"})
    (folder / "result.json").write_text(json.dumps(made.plain()))
    return folder


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run")


def evaluated(run, *arguments):
    """Return the configuration of an evaluation by a command line."""
    chosen = [readable(argument) for argument in command_line([*arguments, f"evaluate={run}"])]
    cfg = compose(chosen)
    return as_trained(cfg, TrainedRun.read(cfg.evaluate), chosen)


def test_evaluation_has_settings_of_its_run(run):
    cfg = evaluated(run)
    assert (cfg.learn, cfg.weights, cfg.evaluate) == ("nothing", "run", str(run))
    assert (cfg.m, cfg.batch_size, cfg.sampler.m_max) == (8, 4, 32)
    assert cfg.dataset.classes == ["chair", "vase", "lamp"]


def test_evaluation_of_another_default_keeps_the_value_of_its_run(tmp_path):
    values: Any = {"batch_size": 7, "sampler.alpha": 5.0, "dataset.test_per_class": 2}
    values |= {"names.net": "hierarchical", "names.stages": "random"}  # by a sweep's file
    cfg = evaluated(write_run(tmp_path / "run", changes={**values, "augment": {}}))
    assert [OmegaConf.select(cfg, path) for path in values] == list(values.values())


def test_evaluation_setting_that_follows_another_follows_the_user(tmp_path):
    run = write_run(tmp_path / "run", [*OVERRIDES, "seed=3"])
    assert evaluated(run).dataset.seed == 3
    assert evaluated(run, "seed=5").dataset.seed == 5
    own = write_run(tmp_path / "own", [*OVERRIDES, "seed=3", "dataset.seed=0"])
    assert evaluated(own).dataset.seed == 0
    assert evaluated(own, "seed=5").dataset.seed == 0


def test_evaluation_same_group_keeps_settings_and_another_drops_them(run, tmp_path):
    assert evaluated(run, "dataset=shapes", "sampler=fmops") == evaluated(run)
    other = evaluated(run, "dataset=meshes", f"dataset.root={tmp_path}")
    assert "train_per_class" not in other.dataset


@pytest.mark.parametrize(
    "given", ["baselines={}", "baselines={fps: null}", "+sampler@baselines.own=critical"]
)
def test_evaluation_repeats_removed_and_added_baselines(given, tmp_path):
    run = write_run(tmp_path / "run", [*OVERRIDES, given])
    assert evaluated(run).baselines == compose([*OVERRIDES, given]).baselines
    start = "+baselines.fps.start=farthest"
    assert evaluated(run, start).baselines.fps == compose([*OVERRIDES, start]).baselines.fps


def test_baselines_of_an_experiment_are_named_as_lost_with_what_adds_them(tmp_path, capsys):
    added = {"_target_": "mops_lightning.samplers.fps.FPSSampler", "start": "farthest"}
    known = composed(*OVERRIDES)["baselines"]
    with_one_more = {**known, "fps_farthest": added, "removed": None}
    run = write_run(tmp_path / "run", changes={"baselines": with_one_more})
    trained = TrainedRun.read(str(run))
    cfg = evaluated(run)

    lost = lost_baselines(cfg, trained, [f"evaluate={run}"])
    running._say_lost_baselines(lost, trained)

    adding = ["+sampler@baselines.fps_farthest=fps", "+baselines.fps_farthest.start=farthest"]
    assert lost == ["fps_farthest"]
    assert " ".join(adding).replace("=fps ", "=SAMPLER ") in capsys.readouterr().out
    again = evaluated(run, *adding).baselines.fps_farthest
    assert added.items() <= again.items()
    assert lost_baselines(cfg, trained, ["baselines={}"]) == []
    assert lost_baselines(cfg, trained, ["baselines.fps=null"]) == []


def test_baselines_of_a_run_as_by_default_are_not_lost(run):
    trained = TrainedRun.read(str(run))

    assert lost_baselines(evaluated(run), trained, [f"evaluate={run}"]) == []


def test_command_line_run_named_in_several_ways(run, tmp_path):
    first = command_line([f"evaluate={run}"])
    for name in (f"evaluate='{run}'", f"+evaluate={run}", f"evaluate={run}/result.json"):
        assert command_line([name]) == first
    strange = tmp_path / "it's (1), a run"
    strange.symlink_to(run)
    assert compose(command_line([f"evaluate={strange}"])).evaluate == str(strange)
    with pytest.raises(UserError, match="takes one run"):
        command_line([f"evaluate={run},{run}"])


def test_command_line_without_evaluate_is_unchanged():
    assert command_line(["m=8", "evaluate=null"]) == ["m=8", "evaluate=null"]
    assert command_line(["--help"]) == ["--help"]
    with pytest.raises(UserError, match=r"^evaluate=: no run is given\. Give a run's folder or "):
        command_line(["task=registration", "evaluate="])


def test_evaluation_leaves_out_removed_setting_that_nobody_gave(tmp_path):
    run = write_run(tmp_path / "run", changes={"sampler.gone": 3})
    assert "gone" not in evaluated(run).sampler
    given = write_run(tmp_path / "given", changes={"sampler.gone": 3}, more=["sampler.gone=3"])
    with pytest.raises(UserError, match=r"evaluate: the record of .* takes no setting 'gone'"):
        evaluated(given)


FOREIGN: list[tuple[str, Any]] = [
    ("sampler._target_", "os.system"),
    ("+dataset.extra._target_", "os.system"),
    ("task/net", "../../evil"),
    ("+sampler@baselines.own", "/evil"),
    ("task/net", "a,b"),
]
"""Classes, paths and sweeps among the overrides of a record."""


@pytest.mark.parametrize(("key", "value"), FOREIGN)
def test_evaluation_record_with_class_or_path_raises(key, value, tmp_path):
    run = write_run(tmp_path / "run", more=[f"{key}={value}"])
    with pytest.raises(UserError, match="not accepted from a record") as refused:
        evaluated(run)
    assert key.lstrip("+") in str(refused.value)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        *((f"names.{group}", "../../../tmp/evil") for group in ("task", "dataset", "sampler")),
        ("sampler.num_sizes", "${oc.env:HOME}"),
        ("sampler.alpha", [{"_target_": "os.system"}]),
        ("dataset.classes", {"a": ["${oc.env:HOME}"]}),
        ("task.x[0]", 1),
    ],
)
def test_evaluation_record_with_path_as_group_or_code_as_value_raises(path, value, tmp_path):
    run = write_run(tmp_path / "run", changes={path: value})
    with pytest.raises(UserError, match="not accepted from a record"):
        evaluated(run)


@pytest.mark.parametrize(
    "path", ["cache", "out", "dataset.cache", "callbacks", "optimizer", "ckpt_path"]
)
def test_evaluation_record_chooses_no_folder_to_write_and_no_part_of_training(path, run, tmp_path):
    evil = write_run(tmp_path / "evil", changes={path: "/evil"})
    same = evaluated(evil)
    same.evaluate = str(run)
    assert same == evaluated(run)


def test_evaluation_record_starts_no_download(tmp_path):
    overrides = ("sampler=fmops", "sampler.m_max=32", "dataset=modelnet40", "out=o", "cache=c")
    evil = write_run(tmp_path / "evil", overrides, {"dataset.download": True})

    repeated = evaluated(evil)

    assert repeated.dataset.download is False
    assert evaluated(evil, "dataset.download=true").dataset.download is True


@pytest.mark.parametrize(
    "argument",
    [
        "task_lr_scale=3",
        "trainer.max_epochs=5",
        "optimizer=exponential",
        "++optimizer.lr=1",
        "learn=sampler",
        "experiment=own_scans",
        "other_nets=null",
        "task.net.sampler.m=8",
    ],
)
def test_evaluation_setting_without_effect_raises(run, argument):
    for more in ([], ["weights=auto"]):
        with pytest.raises(UserError, match="has no effect with evaluate"):
            evaluated(run, argument, *more)


CHANGED: list[tuple[str, Any]] = [
    ("m", 4),
    ("sizes", [4, 16]),
    ("seed", 5),
    ("weights", None),
    ("dataset.n_points", 32),
    ("batch_size", 2),
    ("test_noise_std", 0.1),
    ("test_corruption", "shear-3"),
    ("sampler.threshold", 0.5),
    ("baselines.fps", None),
    ("pictures", 1),
    ("tags", ["again"]),
    ("out", "elsewhere"),
    ("trainer.precision", "32-true"),
]
"""What an evaluation may change, each with another value than the run's."""


@pytest.mark.parametrize(("path", "value"), CHANGED)
def test_evaluation_takes_changes_of_what_is_tested_and_how(run, path, value):
    argument = f"{path}={json.dumps(value)}"

    assert OmegaConf.select(evaluated(run, argument), path) == value


def test_evaluation_takes_another_logger(run):
    target = evaluated(run, "logger=csv").logger._target_

    assert target == compose(["logger=csv"]).logger._target_


@pytest.mark.parametrize(
    "argument",
    [
        "sampler=fps",
        "sampler.m_max=8",
        "++sampler.alpha=3",
        "weights=null",
        "m=8",
        "sizes=[8]",
        "baselines.fps=null",
    ],
)
def test_evaluation_sampler_for_a_task_net_alone_raises(tmp_path, argument):
    run = write_run(tmp_path / "run", [*OVERRIDES, "learn=task"])

    with pytest.raises(UserError, match=r"has no effect .* trained a task net alone\. To test"):
        evaluated(run, argument)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("epochs.task", 2),
        ("pretrain.lr", 0.5),
        ("val_fraction", 0.2),
        ("augment.task.jitter", 0.5),
        ("trainer.accumulate_grad_batches", 2),
    ],
)
def test_evaluation_pretraining_takes_its_settings(run, path, value):
    argument = f"++{path}={value}"

    with pytest.raises(UserError, match=r"has no effect with evaluate, which trains nothing"):
        evaluated(run, argument)

    assert OmegaConf.select(evaluated(run, argument, "weights=auto"), path) == value
