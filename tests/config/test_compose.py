"""Mistakes in settings end in one line, on the command line and in Python."""

import pytest

from mops_lightning.config.check_overrides import check_overrides
from mops_lightning.errors import UserError
from tests.support.command_line import TINY, TINY_WITH_PICTURES, refused

LATE, NET = "+trainer.val_check_interval=100", "task/net=hierarchical"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["mm=32"], "mm: no such setting. Did you mean 'm'?"),
        (["-m", "mm=32,64"], "mm: no such setting. Did you mean 'm'?"),
        (["samplr=fps"], "samplr: no such setting. Did you mean 'sampler'"),
        (["sampler.alhpa=3"], "sampler.alpha"),
        (["sampler=mosp"], "mops"),
        (["sampler/mops=registration"], "chosen by other groups"),
        (["task/nets=pointnet"], "Did you mean 'task/net'"),
        (["sampler.log=2"], "sampler.log: no such setting"),
        (["dataset.download=true"], "no such setting here. It belongs to dataset=modelnet40."),
        (["optimizer.betas=[0.9,0.99]"], "Write +optimizer.betas=..."),
        (["trainer=gpu", *TINY_WITH_PICTURES[1:]], "Try trainer=auto or trainer=cpu"),
        (["dataset=modelnet40", "dataset.root=nowhere"], "dataset.root"),
        (["ckpt_path=last", *TINY_WITH_PICTURES], "ckpt_path=last"),
        ([*TINY_WITH_PICTURES, "dataset.classes=[chair]"], "num_classes must be at least 2"),
        (["logger=null"], "logger=null: choose one with logger=NAME (logger=none for none)"),
        (["callbacks=null"], "callbacks.NAME=null"),
        (["baselines=null"], "baselines=null: choose one"),
        (["sampler=3"], "sampler=3: choose one with sampler=NAME"),
        (["~m"], "m cannot be removed."),
        (["sampler=fps,null"], "sampler=fps,null: choose one"),
        (["sampler=[mops]"], "sampler=[mops]: choose one"),
        (["sampler={}"], "sampler={}: choose one"),
        (["optimizer=[one_cycle,null]"], "choose one with optimizer=NAME"),
        (["=8"], "'=8' has no key. Settings are KEY=VALUE"),
        (["ckpt_path=nowhere.pt", *TINY_WITH_PICTURES], "ckpt_path: no checkpoint nowhere.pt"),
        (["--multirn", "m=8"], "no flag '--multirn'. Did you mean '--multirun'"),
        (["m=8", "--conf", "x"], "no flag '--conf'. Did you mean '--cfg'"),
        (["m=8", "--out=here"], "Settings are KEY=VALUE, without dashes."),
        (["m=8", "--cfg"], "--cfg/-c: expected one argument."),
        (["-m", "m=8,16", "--cfg", "job"], "Only one of --run, --multirun, --cfg"),
        (["--experimental-rerun", "config.pickle"], "--experimental-rerun is not available"),
        (["m=8", "--resolve"], "can only be used in conjunction with --cfg"),
        (["--cfg", "jobs", "m=8"], "--cfg/-c: invalid choice: 'jobs'"),
        (["..=8"], "'..=8' is not a setting. Settings are KEY=VALUE."),
        (["~task/net=3"], "~task/net=3: write ~task/net."),
        (["~sampler"], "~sampler: sampler cannot be removed; choose another one with sampler="),
        (["~callbacks"], "leave single callbacks out with callbacks.NAME=null."),
        ([*TINY, "trainer._target_=builtins.dict"], "must return a Trainer, got dict."),
        ([*TINY, "trainer.precision=16-mixed"], "trainer.precision=bf16-mixed"),
        (["-m", *TINY, "trainer.devices=2", "m=4,8"], "hydra/launcher=joblib"),
        ([*TINY, LATE, "learn=task"], f": {LATE}: not usable in this run: "),
        (["hydra=null"], "hydra=null: choose one"),
        (["hydra.verbose={a: 1}"], "hydra.verbose={a: 1}: give true, false, or a list"),
        (["hydra.verbose=1984"], "give true, false, or a list of loggers."),
        ([*TINY, "++task._target_=collections.Counter"], "must return a Task, got Counter."),
        ([*TINY, "sampler._target_=collections.Counter"], "must return a Sampler, got Counter."),
        (["sampler={a:1}"], "sampler.a: no such setting. Did you mean 'sampler.m'"),
        (["task/net={a:1}"], "task/net={a:1}: choose one with task/net=NAME"),
        (["hydra/job_logging=[[1]]"], "choose one with hydra/job_logging=NAME"),
        ([*TINY, "logger=tensorboard", "+logger.foo=1"], "takes no setting 'foo'"),
        (["names={}"], "names={}: names follow from the chosen groups"),
        (["+names.foo=3"], "names follow from the chosen groups"),
        (["sampler@baselines.x=null"], "sampler@baselines.x=null: choose one"),
        (["sampler@baselines.x=fps"], "no sampler is chosen there. Write +sampler@baselines.x=..."),
        (["sampler@task.net.sampler=mops"], "The stages of hierarchical nets have one."),
        ([NET, "sampler@task.net.sampler=foo"], "task.net.sampler=foo: no such choice."),
        ([NET, "task.net.sampler=fps"], "must be chosen by sampler@task.net.sampler=NAME, got"),
        ([NET, "task.net.sampler.k=7"], "belongs to sampler@task.net.sampler=samplenet and"),
        (["--shell-completion"], "Expecting one subcommand from"),
        (["--shell-completion", "install=sh"], "No completion plugin for"),
        (["pretrain_from=nowhere"], "pretrain_from: no file or model 'nowhere'"),
        (["weights=nowhere.pt", *TINY_WITH_PICTURES], "weights: no file nowhere.pt"),
        (["-m", "seed=range(0,1e9)"], "seed=range(0,1e9): more than 100,000 values."),
        (["task='\n'"], r"task=\n: no such choice. Allowed: classification, "),
        (["seed=" + "n" * 5000], "a whole number of at least 0, got 'nn"),
        ([*TINY, "recipe._target_=null"], "recipe._target_ must be set: give recipe._target_="),
        ([*TINY, "task.net._target_=null"], "task.net._target_ must be set"),
    ],
)
def test_mistake_ends_in_one_line(arguments, said, tmp_path):
    assert said in refused(arguments, tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("dataset", b"_target_: builtins.int", "builtins.int must return a CloudDataset, got int."),
        (
            "experiment",
            b"# @package _global_\nsede: 3",
            "mine.yaml: sede: no such setting. Did you mean 'seed'",
        ),
        ("sampler", "a: é".encode("latin-1"), "a file of settings is not in UTF-8"),
        ("sampler", b"a: [1\nb: 2", "mine.yaml, line 2: not valid YAML: "),
        ("logger", b"_target_: nosuch.Logger", "logger.mine: no such setting."),
    ],
)
def test_mistake_in_a_file_ends_in_one_line(name, content, said, tmp_path):
    (tmp_path / name).mkdir()
    (tmp_path / name / "mine.yaml").write_bytes(content)
    arguments = [f"{name}=mine"] + ["logger.mine=1"] * (name == "logger")
    assert said in refused(["--config-dir", str(tmp_path), *arguments], tmp_path)


def test_mistyped_setting_of_a_sampler_of_ones_own_names_its_settings(tmp_path):
    (tmp_path / "sampler").mkdir()
    text = "_target_: mops_lightning.samplers.fps.FPSSampler\nm: ${m}\ntemperature: 1\n"
    (tmp_path / "sampler" / "mine.yaml").write_text(text)
    for flag in (["--config-dir", str(tmp_path)], [f"--config-dir={tmp_path}"]):
        err = refused([*flag, "sampler=mine", "sampler.temprature=2"], tmp_path)
        assert "no such setting. Did you mean 'sampler.temperature'" in err


@pytest.mark.parametrize("name", ["EarlyStopping", "ModelCheckpoint"])
def test_callback_with_an_unknown_metric_ends_in_one_line(name, tmp_path):
    target = f"+callbacks.mine._target_=lightning.pytorch.callbacks.{name}"
    err = refused([*TINY, "learn=task", target, "+callbacks.mine.monitor=nope"], tmp_path)
    assert "+callbacks.mine.monitor=nope: not usable in this run: " in err


def test_current_folder_that_is_an_interpolation_ends_in_one_line(tmp_path):
    (tmp_path / "${m}").mkdir()
    assert "path of the current folder contains ${" in refused(TINY, tmp_path / "${m}")


def test_check_overrides_takes_names():
    check_overrides(["out='5'", "weights=null", "ckpt_path=last,null", "sampler=fps,mops"])
    check_overrides(["baselines={}"])


@pytest.mark.parametrize("key", ["sampler.alhpa", "sampler.alhpa.inner", "task.net.dropuot"])
def test_check_overrides_inner_key_that_no_file_has_raises(key):
    unknown = key.removesuffix(".inner")

    with pytest.raises(UserError, match=rf"^{unknown}: no such setting\."):
        check_overrides([f"{key}=1"])


@pytest.mark.parametrize(
    "arguments",
    [
        ["+sampler.alhpa=1", "sampler.alhpa=2"],
        ["+sampler.mine={alhpa: 1}", "sampler.mine.alhpa=2"],
        ["sampler=mine", "sampler.alhpa=1"],
        ["sampler._target_=my.Sampler", "sampler.alhpa=1"],
        ["hydra.searchpath=[file:///elsewhere]", "sampler.alhpa=1"],
        ["--config-dir", "elsewhere", "sampler.alhpa=1"],
        ["dataset.classes.0=chair"],
    ],
)
def test_check_overrides_leaves_inner_keys_that_others_may_bring_to_hydra(arguments):
    check_overrides(arguments)
