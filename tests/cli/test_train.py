"""Training from the command line, as a user types it."""

import json

import pytest

from mops_lightning.cli.train import flags_first
from mops_lightning.records import run_record
from mops_lightning.zoo import weights
from tests.support.command_line import (
    SMALL_PCRNET,
    TINY,
    TINY_WITH_PICTURES,
    call,
    done,
    refused,
    runs,
)


@pytest.fixture(scope="module")
def main_job(tmp_path_factory):
    """The main job, small, once: its folder, its run's folder and what it printed."""
    folder = tmp_path_factory.mktemp("main")
    status, out, err = call(TINY_WITH_PICTURES, folder)
    assert status == 0, err
    (run,) = runs(folder)
    return folder, run, out, err


def test_main_job_prints_scores_and_output_paths(main_job):
    folder, run, out, err = main_job
    assert "training it first" in out
    for word in ("random", "voxel", "fps", "generated", "matched", "completed", "accuracy"):
        assert word in out
    last = out.strip().splitlines()[-1]
    for name in ("result.json", "checkpoints/last.ckpt", "pictures"):
        assert name in last
        assert (run / name).exists()
    assert err == "", "nothing but the result is said"


def test_main_job_writes_complete_record(main_job):
    folder, run, *_ = main_job
    record = run_record.read(run)
    assert record.status == "completed"
    assert record.overrides == TINY_WITH_PICTURES
    for readout in ("random", "voxel", "fps", "generated", "matched", "completed", "full"):
        assert 0 <= record.metrics[f"test/{readout}/accuracy"] <= 1
    assert record.score == record.metrics["test/generated/accuracy"]
    assert record.seconds["total"] > record.seconds["fit"] > 0
    assert record.device == "cpu"
    assert record.test_clouds == 3 * len(record.config["dataset"]["classes"])


def test_main_job_records_its_data_nets_and_files(main_job):
    folder, run, *_ = main_job
    record = run_record.read(run)
    (cached,) = (folder / "cache" / "weights").rglob("weights.safetensors")
    net = weights.read(cached)

    assert record.score_name == "test/generated/accuracy"
    assert (record.train_clouds, record.test_clouds) == (12, 9)
    assert record.class_names == ["chair", "lamp", "vase"]
    assert record.part_names == []
    assert record.dataset_fingerprint
    assert record.weights_loaded == record.task_weights_sha256 == net["sha256"]
    assert record.files == {
        "checkpoint": "checkpoints/last.ckpt",
        "clouds": "pictures/clouds.npz",
        "pictures": "pictures",
        "task_weights": "task_weights.safetensors",
        "weights": "weights.safetensors",
    }
    assert record.parameters == {"task": 808003, "sampler": 331584}
    assert record.processes == 1
    assert record.warm_start == {"layers": 4}
    assert record.recipe is not None
    assert (record.recipe["name"], record.recipe["train_points"]) == ("fast", 256)
    assert record.recipe["task_points"] is None  # of the training before
    assert set(record.seconds) == {"data", "pretrain", "fit", "fit_cpu", "test", "total"}
    assert record.validation
    assert all(name.startswith("val/") for name in record.validation)
    assert (record.partial, record.lengthened, record.resumed_from) == ([], False, None)
    assert set(record.versions) == {"python", *run_record.PACKAGES}
    assert record.collapsed == {"8": record.metrics["test/matched/unique_points"]}


def test_main_job_writes_its_settings_figures_and_classes_beside_the_weights(main_job):
    _, run, *_ = main_job
    record = run_record.read(run)

    classes = {}
    for name in ("weights", "task_weights"):
        content = weights.read(run / f"{name}.safetensors")
        assert content["config"] == record.config
        assert content["metrics"] == record.metrics
        classes[name] = content["classes"]

    assert classes == {"weights": [], "task_weights": ["chair", "lamp", "vase"]}


def test_main_job_writes_weights_pictures_and_curves(main_job):
    folder, run, *_ = main_job
    content = weights.read(run / "weights.safetensors")
    assert content["state"]["queries.weight"].shape[0] == 8
    for name in ("clouds.png", "comparison.png", "matrix.png"):
        assert (run / "pictures" / name).read_bytes().startswith(b"\x89PNG")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    tags: dict[str, set[str]] = {}
    for path in run.rglob("events*"):
        accumulator = EventAccumulator(str(path))
        accumulator.Reload()
        for kind, names in accumulator.Tags().items():
            if isinstance(names, list):
                tags.setdefault(kind, set()).update(names)
    for tag in ("train/loss/cross_entropy", "train/loss/subset", "curves/8 tau", "lr-Adam/sampler"):
        assert tag in tags["scalars"]
    assert not [tag for tag in tags["scalars"] if tag.startswith("test/")]
    assert "test/text_summary" in tags["tensors"]
    assert "curves/2 val accuracy, matched" in tags["scalars"]
    assert {"pictures/clouds", "pictures/matrix"} <= tags["images"]


def test_second_run_uses_cached_task_net(main_job):
    folder, *_ = main_job
    out = done([*TINY_WITH_PICTURES, "sampler=fps", "m=4"], folder)
    assert "training it first" not in out
    record = run_record.read(runs(folder)[-1 if "fps" in str(runs(folder)[-1]) else 0])
    assert record.status == "completed"
    assert "test/sampled/accuracy" in record.metrics
    assert "weights" not in record.files


def test_sweep_with_failed_cell_completes_the_rest(main_job):
    folder, *_ = main_job
    fixed = ["out=sweep", "hydra.sweep.dir=sweep/cells"]
    status, out, err = call(["-m", *TINY, "sampler=random", "m=4,65,8", *fixed], folder)
    assert status == 1
    assert "sweep/cells/1 failed: m must be at most the 64 points of a cloud, got 65" in out
    assert "3 cells: 2 completed, 1 failed; in sweep/cells" in out
    assert "files in sweep/cells/: table.md, table.tex, table.csv, report.html" in out
    assert "m must be at most" in (folder / "sweep" / "cells" / "table.md").read_text()
    assert "Traceback" not in out + err
    found = [json.loads(path.read_text()) for path in (folder / "sweep").rglob("result.json")]
    states = {record["config"]["m"]: record["status"] for record in found}
    assert states == {4: "completed", 65: "failed", 8: "completed"}
    # Only the cells of this start count, not what an earlier one has left.
    out = done(["-m", *TINY, "sampler=random", "m=4", *fixed], folder)
    assert "1 cells: 1 completed; in sweep/cells" in out


def test_joint_training_starts_from_cached_task_net(main_job):
    folder, *_ = main_job
    out = done([*TINY, "learn=joint", "out=joint"], folder)
    assert "training it first" not in out
    (path,) = (folder / "joint").rglob("result.json")
    before = next((folder / "cache" / "weights").rglob("weights.safetensors"))
    after = weights.read(path.parent / "task_weights.safetensors")
    assert after["sha256"] != weights.read(before)["sha256"]


def test_registration_trains_jointly_and_is_evaluated_on_other_pairs(tmp_path):
    settings = ["learn=joint", "sampler=fmops", "sampler.m_max=16", "pictures=1"]
    out = done([*TINY_WITH_PICTURES, *SMALL_PCRNET, *settings], tmp_path)
    assert "training it first" in out
    assert "registration by pcrnet, shapes, rotation error (°), test" in out
    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert 0 < record.metrics["test/m16/matched/rotation_error_p90_deg"] < 180
    assert record.score == record.metrics["test/m8/generated/rotation_error_deg"]
    pictures = {f"{name}.png" for name in ("comparison", "clouds", "matrix", "pairs")}
    assert {path.name for path in (run / "pictures").iterdir()} == {"clouds.npz", *pictures}
    assert (run / "task_weights.safetensors").is_file()
    arguments = [f"evaluate={run}", "task.resample=48", "pictures=0"]
    out = done(arguments, tmp_path)
    assert "registration by pcrnet" in out


@pytest.mark.parametrize(
    ("given", "ordered"),
    [
        ("m=8 --cfg job sampler=fps", "--cfg job m=8 sampler=fps"),
        ("m=8,16 -m --config-dir=x ~x +y=2", "-m --config-dir=x m=8,16 ~x +y=2"),
        ("m=8 --info", "--info=all m=8"),
        ("m=8 --info defaults", "--info defaults m=8"),
        ("-m --config-dir sweeps m=8", "-m --config-dir sweeps m=8"),
        ("m=8 m=8 -p trainer m=8 -c job", "-p trainer -c job m=8 m=8 m=8"),
        ("", ""),
    ],
)
def test_flags_first_any_order_keeps_all_arguments(given, ordered):
    assert flags_first(given.split()) == ordered.split()


def test_package_without_cfg_is_refused_and_trains_nothing(tmp_path):
    err = refused(["--package", "x"], tmp_path)
    assert "--package x: chooses what --cfg shows. Add --cfg job, or leave it out." in err
    assert list(tmp_path.iterdir()) == []


def test_interpolation_of_an_unknown_setting_is_named_by_its_own(tmp_path):
    err = refused(["sampler.overlap=${nope}"], tmp_path)
    assert "sampler.overlap: Interpolation key 'nope' not found." in err


def test_augmentation_that_no_file_sets_gets_a_hint(tmp_path):
    err = refused(["augment.sampler.rotate_up=z"], tmp_path)
    assert "no file sets it. Write +augment.sampler.rotate_up=..." in err


def test_override_with_interpolation_is_recorded_as_typed(tmp_path):
    arguments = [*TINY, "sampler=fps", "weights=null", "test_noise_std=${sampler.m}"]
    done(arguments, tmp_path)
    (run,) = runs(tmp_path)
    assert run_record.read(run).overrides == arguments
