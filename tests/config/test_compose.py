"""Mistakes in settings end in one line, on the command line and in Python."""

import pytest

from mops_lightning.config.compose import check_overrides
from mops_lightning.errors import UserError
from tests.support.command_line import TINY, TINY_WITH_PICTURES, call


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sampler.alhpa=3"], "sampler.alpha"),
        (["sampler=mosp"], "mops"),
        (["task=registration", "task/lss=quaternion"], "Did you mean 'task/loss'"),
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
        (["=8"], "'=8' has no key"),
        (["--shell-completion"], "--shell-completion: add install=bash"),
        (["--shell-completion", "install=sh"], "--shell-completion: add install=bash"),
        (["weights=nowhere.pt", *TINY_WITH_PICTURES], "weights: no file nowhere.pt"),
    ],
)
def test_mistake_ends_in_one_line(arguments, said, tmp_path):
    status, _, err = call(arguments, tmp_path)
    assert status == 2
    assert said in err
    assert "Traceback" not in err
    assert err.startswith("mops_lightning: ")
    assert len(err.strip().splitlines()) == 1


def test_dataset_of_another_type_ends_in_one_line(tmp_path):
    (tmp_path / "dataset").mkdir()
    (tmp_path / "dataset" / "mine.yaml").write_text("_target_: builtins.int\n")
    status, _, err = call(["--config-dir", str(tmp_path), "dataset=mine"], tmp_path)
    assert (status, err) == (
        2,
        "mops_lightning: dataset: builtins.int must return a CloudDataset, got int.\n",
    )


def test_unknown_setting_in_a_file_ends_in_one_line(tmp_path):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("# @package _global_\nsede: 3\n")
    status, _, err = call(["--config-dir", str(tmp_path), "experiment=mine"], tmp_path)
    assert status == 2
    assert err.startswith("mops_lightning: experiment/mine.yaml: sede: no such setting.")
    assert "'seed'" in err


@pytest.mark.parametrize("name", ["EarlyStopping", "ModelCheckpoint"])
def test_callback_with_an_unknown_metric_ends_in_one_line(name, tmp_path):
    added = [
        f"+callbacks.mine._target_=lightning.pytorch.callbacks.{name}",
        "+callbacks.mine.monitor=nope",
    ]
    status, _, err = call([*TINY, "learn=task", *added], tmp_path)
    assert status == 2
    assert err.startswith("mops_lightning: callbacks: ")
    assert "nope" in err
    assert len(err.strip().splitlines()) == 1


def test_yaml_in_another_encoding_ends_in_one_line(tmp_path):
    (tmp_path / "sampler").mkdir()
    (tmp_path / "sampler" / "mine.yaml").write_bytes("a: é".encode("latin-1"))
    status, _, err = call(["--config-dir", str(tmp_path), "sampler=mine"], tmp_path)
    assert (status, err.count("\n")) == (2, 1)
    assert "a file is not in UTF-8" in err


def test_current_folder_that_is_an_interpolation_ends_in_one_line(tmp_path):
    (tmp_path / "${m}").mkdir()
    status, _, err = call(TINY, tmp_path / "${m}")
    assert (status, err.count("\n")) == (2, 1)
    assert "path of the current folder contains ${" in err


def test_broken_yaml_ends_in_one_line(tmp_path):
    (tmp_path / "sampler").mkdir()
    (tmp_path / "sampler" / "mine.yaml").write_text("a: [1\nb: 2\n")
    status, _, err = call(["--config-dir", str(tmp_path), "sampler=mine"], tmp_path)
    assert status == 2
    assert "mine.yaml, line 2: not valid YAML: " in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("sampler=fps,null", "sampler=fps,null: choose one"),
        ("sampler=[]", r"sampler=\[\]: choose one"),
        ("sampler=[mops]", r"sampler=\[mops\]: choose one"),
        ("sampler={}", "sampler={}: choose one"),
        ("=8", "'=8' has no key. Settings are KEY=VALUE"),
        ("optimizer=[nan]", r"optimizer=\[nan\]: choose one"),
        ("optimizer=[one_cycle,null]", "choose one with optimizer=NAME"),
    ],
)
def test_check_overrides_mistake_raises(override, said):
    with pytest.raises(UserError, match=said):
        check_overrides([override])


def test_check_overrides_takes_names():
    check_overrides(["out='5'", "weights=null", "ckpt_path=last,null", "sampler=fps,mops"])
    check_overrides(["baselines={}"])
