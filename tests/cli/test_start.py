"""What a refused run leaves."""

import pytest

from mops_lightning.cli.start import check_effect, line_about_run
from mops_lightning.config.compose import compose
from mops_lightning.training.run.run import claim
from tests.support.command_line import TINY, TINY_ANY_DATA, call


def listing(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_run_with_wrong_setting_leaves_nothing(tmp_path):
    status, _, err = call([*TINY, "sampler=fps", "m=0"], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert list(tmp_path.iterdir()) == []


def test_empty_folder_is_refused(tmp_path):
    for setting in ("out", "cache", "weights", "ckpt_path"):
        status, _, err = call([*TINY, f"{setting}="], tmp_path)
        assert (status, err.count("\n")) == (2, 1)
        assert f"{setting}: no path is given" in err
    assert list(tmp_path.iterdir()) == []


def test_path_with_equals_sign_is_a_path(tmp_path):
    arguments = [*TINY_ANY_DATA, "sampler=fps", "dataset=meshes", "dataset.root=a=b", "out=c=d"]
    _, _, err = call(arguments, tmp_path)
    assert "dataset.root" in err
    assert "a=b" in err
    status, out, err = call(["weights=a=b", "out=c=d"], tmp_path)
    assert (status, out) == (2, "")
    assert "weights: no file or model 'a=b'" in err
    assert "out: c=d" in call(["out=c=d", "--cfg", "job"], tmp_path)[1]


def test_second_run_in_folder_writes_nothing(tmp_path):
    claim(tmp_path / "run")
    before = listing(tmp_path)
    status, _, err = call([*TINY, "sampler=fps", "hydra.run.dir=run"], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert "already contains a run" in err
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["sampler=fps", "recipe.distillation=5"], "sampler=fps, which is not trained"),
        (["learn=task", "recipe.ema_span=0.1"], "learn=task. Leave it out"),
    ],
)
def test_recipe_without_effect_is_refused(settings, said, tmp_path):
    status, _, err = call([*TINY, *settings], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert f"mops_lightning: {settings[1]}: has no effect with {said}" in err
    assert list(tmp_path.iterdir()) == []


def test_recipe_of_the_task_net_has_an_effect_without_a_trained_sampler():
    cfg = compose(["sampler=fps"])
    check_effect(cfg, ["sampler=fps", "recipe=paper", "recipe.task_points=[8,64]"])


@pytest.mark.parametrize("setting", ["out", "cache", "weights", "ckpt_path", "evaluate"])
def test_path_of_no_user_ends_in_one_line(setting, tmp_path):
    status, _, err = call([*TINY, f"{setting}=~nosuchuser"], tmp_path)
    assert (status, err.count("\n"), err.count("..")) == (2, 1, 0)


@pytest.mark.parametrize(
    "settings",
    [
        ["+trainer.accumulate_grad_batches=0"],
        ["logger=tensorboard", "+logger.nope=1"],
        ["logger=csv", "+logger.flush_logs_every_n_steps=0"],
    ],
)
def test_setting_that_lightning_refuses_late_is_named(settings, tmp_path):
    status, _, err = call([*TINY, "learn=task", *settings], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert f"mops_lightning: {settings[-1]}: not usable in this run: " in err


def test_fault_outside_lightning_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError) as caught:
        1 / 0  # noqa: B018
    assert line_about_run(caught.value, ["+trainer.accumulate_grad_batches=0"]) is None


def test_run_in_unwritable_folder_ends_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    for place in ("file/run", "/proc/none/run"):
        status, _, err = call([*TINY, "sampler=fps", f"hydra.run.dir={place}"], tmp_path)
        assert (status, err.count("\n")) == (2, 1)
        assert f"out: cannot write to {place}" in err


def test_weights_of_a_model_pass_every_check(tmp_path):
    place = "hydra.run.dir=/proc/none/run"  # refused by the last check
    _, _, err = call([*TINY, "sampler=fps", "weights=pointnet.modelnet40", place], tmp_path)
    assert "out: cannot write to /proc/none/run" in err
    _, _, err = call([*TINY, "sampler=fps", "weights=pointnet.modelnet", place], tmp_path)
    assert "weights: no file or model" in err
    assert "'pointnet.modelnet40'" in err
