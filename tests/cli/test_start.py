"""What a refused run leaves."""

import re

import pytest
from omegaconf import OmegaConf

from mops_lightning.cli.effect import check_effect
from mops_lightning.cli.start import INPUTS, OUTPUTS, check_paths, line_about_run
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run.run import claim
from tests.support.command_line import TINY, TINY_ANY_DATA, call, done, refused


def listing(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("m=0", "m must be a whole number"),
        ("recipe.distillation=5", "mops_lightning: recipe.distillation=5: has no effect with samp"),
        ("hydra.run.dir=~nosuchuser", "no user has this name"),
        *((f"{name}=", name) for name in ("out", "cache", "weights", "ckpt_path", "evaluate")),
        *((f"{name}=~nosuchuser", name) for name in ("out", "cache", "weights", "ckpt_path")),
        ("evaluate=~nosuchuser", "a path begins with ~"),
    ],
)
def test_refused_run_leaves_nothing(argument, said, tmp_path):
    err = refused([*TINY, "sampler=fps", argument], tmp_path)
    assert said in err
    assert ".." not in err
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
    err = refused([*TINY, "sampler=fps", "hydra.run.dir=run"], tmp_path)
    assert "already contains a run" in err
    assert listing(tmp_path) == before


def test_runs_that_start_in_one_second_get_folders_of_their_own(tmp_path):
    settings = [*TINY, "sampler=fps", "hydra.run.dir=runs/${now:noon}"]

    first = done(settings, tmp_path)
    second = done(settings, tmp_path)

    assert "files in runs/noon/" in first
    assert "files in runs/noon_2/" in second
    for name in ("noon", "noon_2"):
        assert (tmp_path / "runs" / name / ".hydra" / "config.yaml").is_file()
        assert (tmp_path / "runs" / name / "result.json").is_file()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["sampler=fps", "recipe.distillation=5"], "with sampler=fps, which is not trained"),
        (["sampler=critical", "optimizer.lr=0.1"], "with sampler=critical, which is not"),
        (["sampler=voxel", "baselines.fps=null"], "with sampler=voxel, which is not trained"),
        (["learn=nothing", "sampler=fps", "recipe.ema_span=0.1"], "with learn=nothing"),
        (["learn=task", "recipe.ema_span=0.1"], "with learn=task"),
        (["learn=task", "sampler.alpha=3"], "with learn=task"),
        (["learn=task", "sizes=[8,16]"], "with learn=task"),
        (["task/net=hierarchical", "task.net.sampler.m=5"], "beside task.net.points"),
        (["learn=task", "pretrain.lr=0.1"], "with learn=task"),
        (["learn=joint", "sampler=fps", "recipe.warm_start=false"], "with sampler=fps, which"),
        (["sampler=fps", "recipe.ema_span=0.1"], "with sampler=fps, which"),
        (["task_lr_scale=0.1"], "with learn=sampler"),
        (["weights=null", "pretrain.lr=0.1"], "with weights=null"),
        (["weights=null", "pretrain_from=x"], "with weights=null"),
        (["weights=null", "recipe.task_points=64"], "with weights=null"),
    ],
)
def test_setting_of_a_part_that_the_run_lacks_is_refused(settings, said):
    with pytest.raises(UserError, match=re.escape(f"{settings[-1]}: has no effect {said}")):
        check_effect(compose(settings), settings)


@pytest.mark.parametrize(
    "settings",
    [
        "sampler=fps recipe=paper recipe.task_points=[8,64] epochs.joint=3 pictures=0",
        "sampler=fps trainer.max_epochs=1 pretrain.lr=0.1 +augment.sampler.jitter=0.1",
        "sampler=fps learn=joint optimizer.lr=0.1 task_lr_scale=0.1",
        "sampler=fps learn=joint recipe.train_points=64 recipe.ema_span=0.1",
        "sampler=gumbel recipe.ema_span=0.1 optimizer.lr=0.1 baselines.fps=null",
        "sampler=snet learn=task recipe=fast recipe.task_points=64 m=8",
        "sampler.anchor_width=1",
        "learn=joint recipe.distillation=1 recipe.nets_per_step=1",
        "recipe=paper recipe.all_points_from=0.5",
        "+trainer.gradient_clip_algorithm=norm",
        "sampler=fmops sampler.num_sizes=8 hydra.run.dir=x sizes=[8]",
    ],
)
def test_setting_of_a_part_that_the_run_has_is_accepted(settings):
    check_effect(compose(settings.split()), settings.split())


IMPOSSIBLE = {
    "": "no path is given. Give one, or leave {} out",
    "~nosuchuser": "",
    "n" * 300: f"{'n' * 100}: File name too long",
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
