"""What a refused run leaves."""

import pytest
from omegaconf import OmegaConf

from mops_lightning.cli.start import INPUTS, OUTPUTS, check_effect, check_paths, line_about_run
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run.run import claim
from tests.support.command_line import TINY, TINY_ANY_DATA, call, refused


def listing(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_run_with_wrong_setting_leaves_nothing(tmp_path):
    refused([*TINY, "sampler=fps", "m=0"], tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_path_with_equals_sign_is_a_path(tmp_path):
    arguments = [*TINY_ANY_DATA, "sampler=fps", "dataset=meshes", "dataset.root=a=b", "out=c=d"]
    _, _, err = call(arguments, tmp_path)
    assert "dataset.root" in err
    assert "a=b" in err
    assert "weights: no file or model 'a=b'" in refused(["weights=a=b", "out=c=d"], tmp_path)
    assert "out: c=d" in call(["out=c=d", "--cfg", "job"], tmp_path)[1]


def test_second_run_in_folder_writes_nothing(tmp_path):
    claim(tmp_path / "run")
    before = listing(tmp_path)
    assert "already contains a run" in refused(
        [*TINY, "sampler=fps", "hydra.run.dir=run"], tmp_path
    )
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["sampler=fps", "recipe.distillation=5"], "sampler=fps, which is not trained"),
        (["learn=task", "recipe.ema_span=0.1"], "learn=task. Leave it out"),
    ],
)
def test_recipe_without_effect_is_refused(settings, said, tmp_path):
    err = refused([*TINY, *settings], tmp_path)
    assert f"mops_lightning: {settings[1]}: has no effect with {said}" in err
    assert list(tmp_path.iterdir()) == []


def test_recipe_of_the_task_net_has_an_effect_without_a_trained_sampler():
    cfg = compose(["sampler=fps"])
    check_effect(cfg, ["sampler=fps", "recipe=paper", "recipe.task_points=[8,64]"])


IMPOSSIBLE = {
    "": "no path is given. Give one, or leave {} out",
    "~nosuchuser": "",
    "n" * 300: f"{'n' * 60} ... (300 characters): File name too long",
    "loop/below": "loop/below: Too many levels of symbolic links",
    "file/below": "file/below: Not a directory",
}


@pytest.mark.parametrize("setting", [*INPUTS, *OUTPUTS])
def test_check_paths_impossible_path_is_one_line(setting, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "file").touch()
    for value, said in IMPOSSIBLE.items():
        cfg = OmegaConf.create()
        OmegaConf.update(cfg, setting, value)
        with pytest.raises(UserError) as error:
            check_paths(cfg)
        assert str(error.value).startswith(f"{setting}: {said.format(setting)}"), value
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", ["", "~nosuchuser"])
def test_run_with_an_impossible_path_leaves_nothing(value, tmp_path):
    for setting in ("out", "cache", "weights", "ckpt_path", "evaluate"):
        assert ".." not in refused([*TINY, f"{setting}={value}"], tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "settings",
    [
        ["+trainer.accumulate_grad_batches=0"],
        ["logger=tensorboard", "+logger.nope=1"],
        ["logger=csv", "+logger.flush_logs_every_n_steps=0"],
    ],
)
def test_setting_that_lightning_refuses_late_is_named(settings, tmp_path):
    err = refused([*TINY, "learn=task", *settings], tmp_path)
    assert f"mops_lightning: {settings[-1]}: not usable in this run: " in err


def test_fault_outside_lightning_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError) as caught:
        1 / 0  # noqa: B018
    assert line_about_run(caught.value, ["+trainer.accumulate_grad_batches=0"]) is None


def test_run_in_unwritable_folder_ends_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    for place in ("file/run", "/proc/none/run"):
        err = refused([*TINY, "sampler=fps", f"hydra.run.dir={place}"], tmp_path)
        assert f"out: cannot write to {place}" in err


def test_weights_of_a_model_pass_every_check(tmp_path):
    place = "hydra.run.dir=/proc/none/run"  # refused by the last check
    err = refused([*TINY, "sampler=fps", "weights=pointnet.modelnet40", place], tmp_path)
    assert "out: cannot write to /proc/none/run" in err
    err = refused([*TINY, "sampler=fps", "weights=pointnet.modelnet", place], tmp_path)
    assert "weights: no file or model" in err
    assert "'pointnet.modelnet40'" in err
