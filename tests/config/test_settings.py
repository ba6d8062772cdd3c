"""The declaration of settings, and a made-up setting that everything finds there."""

import re
from dataclasses import dataclass
from typing import Any

import pytest
from omegaconf import OmegaConf

from mops_lightning.cli.sweep import run_cell
from mops_lightning.config import settings
from mops_lightning.config.compose import compose
from mops_lightning.config.declaration import Affects, Training
from mops_lightning.config.limits import number
from mops_lightning.config.settings import RunSettings, setting
from mops_lightning.config.validate import check
from mops_lightning.errors import UserError
from mops_lightning.report.build import build_report
from mops_lightning.training.as_trained import as_trained
from mops_lightning.training.checkpoint import checkpoint_identity
from mops_lightning.training.evaluation import TrainedRun, command_line
from mops_lightning.training.run.pretrain import cache_folder
from tests.support.command_line import TINY, call
from tests.support.reports import edited, put_cell
from tests.support.training import small_dataset

DATA = small_dataset(train=4, test=4)


@pytest.mark.parametrize("path", ["m", "batch_size", "epochs.task", "pictures"])
def test_whole_numbers_are_no_truth_values(path):
    limits = settings.limits(path)

    assert limits is not None
    assert limits.fits(2)
    assert not limits.fits(True)
    assert not limits.fits(2.0)


def test_sizes_are_no_truth_values():
    with pytest.raises(UserError, match=r"sizes must be auto or a list of whole numbers"):
        check(compose(["sampler=fps", "sizes=[8,true]"]))


def test_checkpoint_without_a_training_is_refused():
    with pytest.raises(UserError, match=r"ckpt_path resumes training; to test a trained run give"):
        check(compose(["sampler=fps", "learn=nothing", "ckpt_path=last"]))


def identity_of(cfg):
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    return checkpoint_identity(config, "data")


@pytest.fixture(params=[Affects.TRAINING, Affects.SCORES, Affects.NOTHING], ids=str)
def affects(request, monkeypatch):
    """Declare the setting ``haste``, and say what it affects."""
    limits = number("of at least 0", lambda x: x >= 0)

    @dataclass
    class WithHaste(RunSettings):
        haste: float = setting(1.0, "how much haste there is", request.param, limits=limits)

    monkeypatch.setattr(settings, "SCHEMA", WithHaste)
    settings.register()
    yield request.param
    monkeypatch.undo()
    settings.register()


@pytest.mark.parametrize("affects", [Affects.TRAINING], indirect=True, ids=str)
def test_made_up_setting_is_shown_by_help_and_validated(affects, tmp_path):
    assert re.search("haste +how much haste there is", call(["--help"], tmp_path)[1])
    check(compose(["haste=2"]))
    for value in ("-1", "much", "null"):
        with pytest.raises(UserError, match="haste must be a number of at least 0, got"):
            check(compose([f"haste={value}"]))
    with pytest.raises(UserError, match="Did you mean 'haste'"):
        check(compose(["+hast=1"]))


def test_made_up_setting_of_training_is_in_identity_and_cache_key(affects):
    trains = affects is Affects.TRAINING
    plain = compose()
    changed = compose(["haste=2"])

    assert ("haste" in identity_of(plain)) == trains
    assert (identity_of(plain) != identity_of(changed)) == trains
    assert (cache_folder(plain, DATA) != cache_folder(changed, DATA)) == trains


def test_made_up_setting_that_affects_results_may_not_differ_in_a_sweep(affects, tmp_path, caplog):
    overrides = [*TINY, "sampler=fps", "weights=null"]
    run_cell(compose(overrides), tmp_path / "cell", overrides)
    run_cell(compose([*overrides, "haste=2"]), tmp_path / "cell", overrides)
    refused = "other settings: haste was 1.0, got 2.0" in caplog.text
    assert refused == (affects is not Affects.NOTHING)


def test_made_up_setting_that_affects_results_is_repeated_by_evaluate(affects, tmp_path):
    path = put_cell(tmp_path, "run", "mops", {"generated": 1.0})
    config: Any = OmegaConf.to_container(compose(), resolve=True)
    config["haste"] = 2.0
    edited(path, config=config, files={"weights": "weights.safetensors"})

    chosen = command_line([f"evaluate={path.parent}"])
    cfg = as_trained(compose(chosen), TrainedRun.read(str(path.parent)), chosen)

    assert (cfg.haste == 2) == (affects is not Affects.NOTHING)


def test_made_up_setting_that_affects_results_makes_columns_of_a_report(affects, tmp_path):
    for haste in (1.0, 2.0):
        put_cell(tmp_path, f"a{haste}", "mops", {"generated": haste}, haste=haste, m=8)

    head = build_report(tmp_path).grids[0].head

    if affects is Affects.NOTHING:
        assert head[:2] == ["sampled by", "m=8"]
    else:
        assert head[:3] == ["sampled by", "haste=1.0", "haste=2.0"]


@pytest.mark.parametrize(
    ("path", "affects", "repeated", "compared"),
    [
        ("seed", Affects.RESULTS, True, False),
        ("learn", Affects.TRAINING, False, False),
        ("pictures", Affects.NOTHING, False, False),
        ("task.net.dropout", Affects.RESULTS, True, True),
        ("dataset.cache", Affects.NOTHING, False, False),
        ("optimizer.schedule.warmup", Affects.TRAINING, False, True),
        ("trainer.precision", Affects.TRAINING, False, False),
        ("trainer.accelerator", Affects.NOTHING, False, False),
    ],
)
def test_of_a_path_gives_the_nearest_declaration(path, affects, repeated, compared):
    declared = settings.of(path)

    assert declared.affects == affects
    assert declared.repeated == repeated
    assert declared.compared == compared


@pytest.mark.parametrize(
    ("path", "trainings"),
    [
        ("recipe.distillation", Training.SAMPLER),
        ("recipe.ema_span", Training.JOINT | Training.SAMPLER),
        ("recipe.task_points", Training.FIRST | Training.TASK_NET),
        ("pretrain.lr", Training.FIRST),
        ("optimizer.lr", Training.TASK_NET | Training.JOINT | Training.SAMPLER),
        ("batch_size", None),
    ],
)
def test_of_a_path_says_which_trainings_it_serves(path, trainings):
    assert settings.of(path).serves == trainings


def test_defaults_of_the_schema_are_the_composed_values():
    cfg: Any = OmegaConf.to_container(compose(), resolve=False)
    assert set(cfg) == set(settings.declared())
