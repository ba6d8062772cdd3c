from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from mops_lightning import load
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.zoo import model_file, names, publish, weights
from tests.support.models import NAMES, rewrite, write_run
from tests.support.records import evaluated, record

OF_TASK_NET = {"metrics": {"test/full/accuracy": 0.5}, "score_name": "test/full/accuracy"}
"""Fields of the record of a task net."""


@pytest.fixture
def run(tmp_path):
    write_run(tmp_path / "run")
    return tmp_path / "run"


def test_card_is_written_from_the_record(run, tmp_path):
    path = publish.add(run, "fmops.mine", tmp_path, licence="CC0")

    card = model_file.read_card(path)
    assert card["figures"] == {
        "metric": "accuracy (%)",
        "m": 8,
        "points": 64,
        "values": {"generated": "50.00"},
    }
    assert card["licence"] == "CC0"
    assert card["precision"] == "float32"
    assert card["name"] == "fmops.mine"
    assert card["record"]["metrics"] == run_record.read(run).metrics


def test_card_of_several_sizes_has_the_figures_of_the_own_one():
    metrics = {
        "test/m8/generated/accuracy": 0.25,
        "test/m32/generated/accuracy": 0.5,
        "test/m32/matched/accuracy": 0.75,
        "test/m32/fps/accuracy": 0.125,
        "test/m32/generated/subset_distance": 0.1,
        "test/full/accuracy": 0.875,
    }
    made = record(metrics=metrics, score_name="test/m32/generated/accuracy")

    figures = publish.card_figures(made)

    assert figures["m"] == 32
    assert figures["values"] == {"generated": "50.00", "matched": "75.00"}


def test_card_of_a_task_net_has_the_figure_of_all_points():
    config = {"learn": "task", "dataset": {"n_points": 64}}
    metrics = {"test/full/accuracy": 0.875}
    made = record(config, metrics=metrics, score_name="test/full/accuracy")

    assert publish.card_figures(made) == {
        "metric": "accuracy (%)",
        "m": None,
        "points": 64,
        "values": {"full": "87.50"},
    }


def files_on_card(model):
    """Return the files of the record on a model's card."""
    return model_file.read_card(model)["record"]["files"]


def test_task_net_is_found_by_hash_or_name(run, tmp_path):
    task_net = names.available()["pointnet.modelnet40"]
    sha256 = model_file.read_card(task_net)["sha256"]
    reference = names.pinned("pointnet.modelnet40", sha256)

    for digest in ("weights_loaded", "task_weights_sha256"):
        other = tmp_path / digest
        write_run(other, **{digest: sha256})
        model = publish.add(other, f"fmops.{digest}", tmp_path)
        assert files_on_card(model)["task_weights"] == reference

    model = publish.add(run, "fmops.none", tmp_path)
    assert "task_weights" not in files_on_card(model)

    model = publish.add(run, "fmops.given", tmp_path, task_net="pointnet.modelnet40")
    assert files_on_card(model)["task_weights"] == reference
    assert weights.of_run(model, "task_weights") == task_net


@pytest.mark.parametrize(("precision", "bits"), [("float16", 16), ("bfloat16", 16), ("int8", 8)])
def test_wide_layers_are_rounded(precision, bits, run, tmp_path):
    path = publish.add(run, "fmops.small", tmp_path, precision=precision, notes="Mine.")

    card = model_file.read_card(path)
    assert card["precision"] == precision
    before = "The test figures are those before wide layers were rounded"
    assert card["notes"] == f"Mine. {before} to {bits} bits."
    stored = load_file(path)
    assert str(stored["rho_local.weight"].dtype) == f"torch.{precision}"
    assert stored["queries.weight"].dtype == torch.float32  # 2,048 entries
    given = weights.read(run / weights.FILE)["state"]["rho_local.weight"]
    sampler: Any = load(path)
    assert sampler.rho_local.weight.dtype == torch.float32
    torch.testing.assert_close(sampler.rho_local.weight, given, rtol=0.004, atol=0.001)


def evaluation(folder, sha256, **fields):
    """Write the record of a test of a model."""
    folder.mkdir()
    fields = {"metrics": {"test/m8/generated/accuracy": 0.25}, **fields}
    config = {"learn": "nothing", "m": 8, "names": NAMES, "dataset": {"n_points": 64}}
    config |= fields.pop("config", {})
    tested = {"config": config, **fields}
    tested["score_name"] = "test/m8/generated/accuracy"
    tested["evaluated"] = evaluated(weights_sha256=sha256)
    run_record.write(folder, record(**tested))
    return folder


def test_a_rounded_model_gets_its_own_figures(run, tmp_path):
    path = publish.add(run, "fmops.small", tmp_path, precision="int8", notes="Mine.")
    card = model_file.read_card(path)
    assert card["figures"]["values"] == {"generated": "50.00"}
    stored = load_file(path)

    publish.measure(path, evaluation(tmp_path / "tested", card["sha256"]))

    measured = model_file.read_card(path)
    assert measured["figures"]["values"] == {"generated": "25.00"}
    before = "Wide layers are in 8 bits; the record's figures are those before."
    assert measured["notes"] == f"Mine. {before}"
    same = {key: value for key, value in card.items() if key not in ("figures", "notes")}
    assert same.items() <= measured.items()
    for name, value in load_file(path).items():
        assert value.dtype == stored[name].dtype
        assert torch.equal(value, stored[name])


def test_figures_of_another_test_are_refused(run, tmp_path):
    path = publish.add(run, "fmops.small", tmp_path)
    sha256 = model_file.read_card(path)["sha256"]

    with pytest.raises(
        UserError, match=r"run did not test .*\. Give the folder of a run of evaluate="
    ):
        publish.measure(path, run)
    with pytest.raises(UserError, match="other did not test"):
        publish.measure(path, evaluation(tmp_path / "other", "0" * 64))
    short = evaluation(tmp_path / "short", sha256, partial=["tested on 1 of 4 batches"])
    with pytest.raises(UserError, match=r"short is not a whole test\. Repeat it"):
        publish.measure(path, short)
    for place, of_data in (
        ("noisy", {"config": {"test_noise_std": 0.1}}),
        ("few", {"test_clouds": 3}),
        ("others", {"config": {"names": {**NAMES, "dataset": "scans"}}}),
    ):
        tested = evaluation(tmp_path / place, sha256, **of_data)
        with pytest.raises(UserError, match=rf"{place} tested .* on other data than the run"):
            publish.measure(path, tested)


def test_a_damaged_model_gets_no_new_header(run, tmp_path):
    path = publish.add(run, "fmops.small", tmp_path, precision="int8")
    sha256 = model_file.read_card(path)["sha256"]
    zeros = {"rho_local.weight.scale": torch.zeros(512, 1)}
    rewrite(path, zeros, sha256=sha256)

    with pytest.raises(weights.Damaged, match="sha256 differs"):
        publish.measure(path, evaluation(tmp_path / "tested", sha256))


@pytest.mark.parametrize("precision", ["int4", "INT8", "float64", None])
def test_other_precisions_are_refused(precision, run, tmp_path):
    allowed = "float32, float16, bfloat16, int8"
    with pytest.raises(UserError, match=f"precision must be one of {allowed}, got {precision!r}"):
        publish.add(run, "fmops.small", tmp_path, precision=precision)


def test_shortened_run_is_no_model(run, tmp_path):
    shortened = run_record.read(run)
    shortened.partial.append("tested on 1 of 4 batches")
    run_record.write(run, shortened)

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
    sha256 = model_file.read_card(path)["sha256"]
    naming = run_record.read(run)
    naming.files["weights"] = names.pinned("fmops.mine", sha256)
    naming.files["task_weights"] = "pointnet.modelnet40"
    run_record.write(run, naming)
    (run / weights.FILE).unlink()

    assert weights.of_run(run) == path
    assert weights.of_run(run, "task_weights") == names.available()["pointnet.modelnet40"]

    rewrite(path, {"queries.weight": torch.ones(16, 128)})
    with pytest.raises(UserError, match="now has other weights"):
        weights.of_run(run)


def test_nets_of_a_sweep_become_models_task_nets_first(tmp_path):
    sweep = tmp_path / "My Sweep"
    write_run(sweep / "b" / "Net M8")
    write_run(sweep / "a-joint", learn="joint")
    write_run(sweep / "z-net", learn="task", **OF_TASK_NET)
    write_run(sweep / "failed", status="failed")
    runs = [sweep / name for name in ("b/Net M8", "failed", "a-joint", "z-net")]

    added = publish.add_all(runs, sweep, tmp_path / "models")

    names_of_files = [path.stem for path in added]
    assert names_of_files == ["my-sweep.z-net", "my-sweep.a-joint", "my-sweep.b-net-m8"]
    assert "task_weights" not in files_on_card(added[1])  # a joint run has one of its own


def test_card_has_the_channels_of_the_run(run, tmp_path):
    content = weights.read(run / weights.FILE)
    channels = PointChannels([Channel("intensity", 100.0, 50.0)])
    net = load(run)
    weights.save(run / weights.FILE, net, content["config"], {}, channels=channels)

    card = model_file.read_card(publish.add(run, "fmops.mine", tmp_path))

    assert card["channels"] == [["intensity", 100.0, 50.0]]
    assert "channels" not in model_file.read_card(publish.add(other_run(tmp_path), "a.b", tmp_path))


def other_run(folder):
    write_run(folder / "other")
    return folder / "other"


@pytest.mark.parametrize(("entries", "precision"), [(4096, "float16"), (4095, "float32")])
def test_matrices_of_4096_entries_and_more_are_rounded(entries, precision, run, tmp_path):
    path = run / weights.FILE
    config = weights.read(path)["config"]
    net = torch.nn.Linear(entries, 1, bias=False)
    weights.save(path, net, config, {})

    card = model_file.read_card(publish.add(run, "fmops.mine", tmp_path, precision="float16"))

    assert card["precision"] == precision
