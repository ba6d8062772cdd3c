"""Loggers other than TensorBoard."""

import csv
from importlib.util import find_spec
from typing import Any

import pytest
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run.run import run
from tests.support.command_line import TINY

CURVES = ["sampler=mops", "weights=null", "val_fraction=0.2"]


def logged(tmp_path, *arguments):
    plain = [one for one in TINY if not one.startswith("logger")]
    overrides = [*plain, *CURVES, f"cache={tmp_path}/cache", *arguments]
    return run(compose(overrides), tmp_path / "run", overrides)


def test_csv_logger_writes_curves_and_the_test_after_the_last_step(tmp_path):
    record = logged(tmp_path, "logger=csv")

    with (tmp_path / "run" / "csv" / "metrics.csv").open() as file:
        lines = list(csv.DictReader(file))

    (tested,) = [line for line in lines if line["test/generated/accuracy"]]
    for name, value in record.metrics.items():
        assert float(tested[name]) == pytest.approx(value, abs=1e-6), name
    assert int(tested["step"]) == 2  # of one epoch
    assert "train/mean_loss" in lines[0]
    names = {path.name for path in (tmp_path / "run" / "csv").iterdir()}
    assert names == {"hparams.yaml", "metrics.csv"}  # no folder of a version


def test_csv_logger_writes_the_settings_that_distinguish_runs(tmp_path):
    logged(tmp_path, "logger=csv", "tags=[first,wide]", "seed=3", "+augment.sampler.jitter=0.5")

    path = tmp_path / "run" / "csv" / "hparams.yaml"
    found: Any = OmegaConf.to_container(OmegaConf.load(path))

    expected = {
        "names.task": "classification",
        "names.net": "pointnet",
        "names.dataset": "shapes",
        "names.sampler": "mops",
        "names.recipe": "fast",
        "sampler.m": 8,
        "sampler.alpha": 30.0,
        "sampler.tau_min": 0.1,
        "optimizer.lr": 0.001,
        "optimizer.schedule.warmup": 0.3,
        "augment.sampler.jitter": 0.5,
        "m": 8,
        "learn": "sampler",
        "seed": 3,
        "batch_size": 4,
        "max_epochs": 1,
        "tags": "first, wide",
    }
    assert {name: found[name] for name in expected} == expected
    tops = {name.partition(".")[0] for name in found}
    assert tops == {name.partition(".")[0] for name in expected}
    assert not any("._" in name for name in found)


def test_logger_with_a_name_of_the_users_keeps_it(tmp_path):
    logged(tmp_path, "logger=csv", "+logger.name=mine", "+logger.version=second")

    assert (tmp_path / "run" / "mine" / "second" / "metrics.csv").is_file()


def test_mlflow_logger_writes_settings_and_curves(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="the extra 'mlflow' is not installed")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    store = f"file:{tmp_path}/mlruns"
    record = logged(tmp_path, "logger=mlflow", f"logger.tracking_uri={store}")
    client = mlflow.MlflowClient(store)
    (experiment,) = client.search_experiments(filter_string="name = 'mops_lightning'")
    (found,) = client.search_runs([experiment.experiment_id])
    assert found.data.params["sampler.tau_min"] == "0.1"
    score = record.metrics["test/generated/accuracy"]
    assert found.data.metrics["test/generated/accuracy"] == pytest.approx(score)
    assert found.info.status == "FINISHED"


@pytest.mark.parametrize("name", ["mlflow", "wandb"])
def test_logger_missing_package_raises(name, tmp_path):
    if find_spec(name):
        pytest.skip(f"{name} is installed")
    with pytest.raises(UserError, match=f"needs a package that is not installed: .*{name}"):
        logged(tmp_path, f"logger={name}")
