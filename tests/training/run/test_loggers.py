"""Loggers other than TensorBoard."""

import csv
from importlib.util import find_spec

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run.run import run
from tests.support.command_line import TINY

CURVES = ["sampler=mops", "weights=null", "val_fraction=0.2"]


def logged(tmp_path, *arguments):
    plain = [one for one in TINY if not one.startswith("logger")]
    overrides = [*plain, *CURVES, f"cache={tmp_path}/cache", *arguments]
    return run(compose(overrides), tmp_path / "run", overrides)


def test_csv_logger_writes_curves(tmp_path):
    record = logged(tmp_path, "logger=csv")
    with (tmp_path / "run" / "csv" / "metrics.csv").open() as file:
        values = [line["test/generated/accuracy"] for line in csv.DictReader(file)]
    score = record.metrics["test/generated/accuracy"]
    assert float(next(filter(None, values))) == pytest.approx(score)


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
