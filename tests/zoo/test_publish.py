import pytest
import torch

from mops_lightning import load
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.zoo import model_file, names, publish, weights
from tests.support.models import rewrite, write_run


@pytest.fixture
def run(tmp_path):
    write_run(tmp_path / "run")
    return tmp_path / "run"


def test_card_is_written_from_the_record(run, tmp_path):
    card = model_file.read_card(publish.add(run, "fmops.mine", tmp_path, licence="CC0"))
    figures = {"metric": "accuracy (%)", "m": 8, "points": 64, "values": {"generated": "50.00"}}
    assert card["figures"] == figures
    assert (card["licence"], card["precision"], card["name"]) == ("CC0", "float32", "fmops.mine")
    assert card["record"]["metrics"] == run_record.read(run).metrics


def test_task_net_is_found_by_hash_or_name(run, tmp_path):
    for digest in ("weights_loaded", "task_weights_sha256"):
        sha256 = model_file.read_card(names.available()["pointnet.modelnet40"])["sha256"]
        other = tmp_path / digest
        write_run(other, **{digest: sha256})
        card = model_file.read_card(publish.add(other, f"fmops.{digest}", tmp_path))
        reference = names.pinned("pointnet.modelnet40", sha256)
        assert card["record"]["files"]["task_weights"] == reference
    card = model_file.read_card(publish.add(run, "fmops.none", tmp_path))
    assert "task_weights" not in card["record"]["files"]
    path = publish.add(run, "fmops.given", tmp_path, task_net="pointnet.modelnet40")
    assert model_file.read_card(path)["record"]["files"]["task_weights"] == reference
    assert weights.of_run(path, "task_weights") == names.available()["pointnet.modelnet40"]


def test_half_precision_is_for_wide_layers(run, tmp_path):
    path = publish.add(run, "fmops.half", tmp_path, half=True, notes="Mine.")
    content = weights.read(path)
    card = model_file.read_card(path)
    assert (card["precision"], card["notes"]) == ("float16", f"Mine. {publish.ROUNDED}")
    assert content["state"]["rho_local.weight"].dtype == torch.float16
    assert content["state"]["queries.weight"].dtype == torch.float32  # 2,048 entries
    assert load(path).rho_local.weight.dtype == torch.float32  # type: ignore[union-attr]


def test_shortened_run_is_no_model(run, tmp_path):
    record = run_record.read(run)
    record.partial.append("tested on 1 of 4 batches")
    run_record.write(run, record)

    with pytest.raises(UserError, match=r"run: tested on 1 of 4 batches\. A model is made"):
        publish.add(run, "fmops.mine", tmp_path)


@pytest.mark.parametrize("name", ["mine", "Fmops.mine", "../a.b", "a.pt", "a..b", "a.b/c", ""])
def test_other_names_are_refused(run, tmp_path, name):
    with pytest.raises(UserError, match="NAME must be words"):
        publish.add(run, name, tmp_path)


def test_taken_name_is_refused_unless_overwritten_and_sampler_as_task_net(run, tmp_path):
    publish.add(run, "fmops.mine", tmp_path)
    with pytest.raises(UserError, match=r"exists.*--overwrite"):
        publish.add(run, "fmops.mine", tmp_path)
    publish.add(run, "fmops.mine", tmp_path, overwrite=True)
    with pytest.raises(UserError, match=r"--task-net: fmops\.airplane-m256 is a sampler"):
        publish.add(run, "fmops.other", tmp_path, task_net="fmops.airplane-m256")


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"status": "failed"}, "not a completed run that kept its weights"),
        ({"files": {}}, "not a completed run that kept its weights"),
        ({"metrics": {}, "score_name": ""}, "no test score"),
    ],
)
def test_runs_without_weights_or_scores_are_refused(tmp_path, fields, words):
    write_run(tmp_path / "run", **fields)
    with pytest.raises(UserError, match=words):
        publish.add(tmp_path / "run", "fmops.mine", tmp_path)


def test_record_that_names_a_model_gives_its_weights(run, tmp_path, monkeypatch):
    monkeypatch.setenv(names.VARIABLE, str(tmp_path))
    path = publish.add(run, "fmops.mine", tmp_path, task_net="pointnet.modelnet40")
    record = run_record.read(run)
    reference = names.pinned("fmops.mine", model_file.read_card(path)["sha256"])
    record.files |= {"weights": reference, "task_weights": "pointnet.modelnet40"}
    run_record.write(run, record)
    (run / weights.FILE).unlink()
    assert weights.of_run(run) == path
    assert weights.of_run(run, "task_weights") == names.available()["pointnet.modelnet40"]
    rewrite(path, {"queries.weight": torch.ones(16, 128)})
    with pytest.raises(UserError, match="now has other weights"):
        weights.of_run(run)
