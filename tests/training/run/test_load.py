import json
import shutil
from dataclasses import replace

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.config.overrides import readable
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.records import run_record
from mops_lightning.records.run_record import Evaluated
from mops_lightning.training.evaluation import command_line
from mops_lightning.training.run.load import _changed_settings
from mops_lightning.training.run.run import run
from mops_lightning.zoo import publish, weights
from mops_lightning.zoo.load import load_net
from tests.support.command_line import job, refused, runs


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A small FMOPS-Net run: its folder, its record and its cache."""
    folder = tmp_path_factory.mktemp("evaluate")
    return folder / "run", job(folder / "run", "sampler=fmops", "sampler.m_max=32")


def evaluated(trained, tmp_path, *arguments):
    chosen = command_line([f"evaluate={trained[0]}", "pictures=0", "logger=none", *arguments])
    chosen = [readable(argument) for argument in chosen]
    return run(compose(chosen), tmp_path / "new", chosen)


def test_evaluate_without_changes_repeats_metrics(trained, tmp_path):
    folder, record = trained

    again = evaluated(trained, tmp_path)

    assert again.metrics == record.metrics
    saved = weights.read(folder / weights.FILE)
    assert again.evaluated == Evaluated(
        run=str(folder),
        commit=record.git["commit"],
        max_epochs=1,
        learn="sampler",
        recipe=record.recipe,
        seed=0,
        dataset="shapes",
        weights_sha256=saved["sha256"],
    )
    assert again.task_weights_sha256 == record.task_weights_sha256
    assert "fit" not in again.seconds
    assert again.config["learn"] == "nothing"
    assert not (tmp_path / "new" / "weights.safetensors").exists()


def test_evaluate_follows_weights_path_of_record(trained, tmp_path):
    folder, record = trained
    (tmp_path / "kept").mkdir()
    (tmp_path / "run").mkdir()
    shutil.copy(folder / "weights.safetensors", tmp_path / "kept" / "sampler.pt")
    (cached,) = (folder.parent / "cache" / "weights").rglob("weights.safetensors")
    shutil.copy(cached, tmp_path / "kept" / "net.pt")
    files = {"weights": "../kept/sampler.pt", "task_weights": "../kept/net.pt"}
    run_record.write(tmp_path / "run", replace(record, files=files))
    again = evaluated((tmp_path / "run", record), tmp_path)
    assert again.metrics == record.metrics


def changed_record(trained, folder, sampler):
    """Copy a run, with other sampler's settings in its record."""
    shutil.copytree(trained[0], folder)
    record = trained[1]
    run_record.write(folder, replace(record, config={**record.config, "sampler": sampler}))
    return folder, record


def test_evaluate_older_record_without_newer_setting(trained, tmp_path):
    sampler = {k: v for k, v in trained[1].config["sampler"].items() if k != "min_size"}
    assert sampler != trained[1].config["sampler"]
    older = changed_record(trained, tmp_path / "run", sampler)
    again = evaluated(older, tmp_path)
    assert again.metrics == trained[1].metrics
    # The constructor's default, not that of today's configuration.
    assert (again.config["sampler"]["min_size"], trained[1].config["sampler"]["min_size"]) == (1, 8)
    with pytest.raises(UserError, match=r"sampler\.min_size must be 1, as in .*, got 2"):
        evaluated(older, tmp_path / "other", "sampler.min_size=2")


@pytest.mark.parametrize(
    "changes",
    [
        {"size_sampling": "uniform", "feature_channels": [64, 64, 64, 128, 128]},
        {"_target_": "pathlib.Path"},
    ],
)
def test_evaluate_takes_settings_of_a_recipe_but_no_code_from_a_record(trained, tmp_path, changes):
    sampler = {**trained[1].config["sampler"], **changes}
    again = evaluated(changed_record(trained, tmp_path / "run", sampler), tmp_path)
    assert again.config["sampler"]["size_sampling"] == sampler["size_sampling"]
    assert again.metrics == trained[1].metrics


def test_evaluate_wrong_value_in_record_or_other_sampler_leaves_nothing(trained, tmp_path):
    sampler = {**trained[1].config["sampler"], "alpha": "abc"}
    folder, _ = changed_record(trained, tmp_path / "run", sampler)
    err = refused([f"evaluate={folder}"], tmp_path)
    assert f"evaluate: the record of {folder}: sampler.alpha must be a number" in err
    err = refused([f"evaluate={trained[0]}", "sampler=mops"], tmp_path)
    assert "was trained with sampler=fmops, got sampler=mops. Leave sampler out" in err
    assert runs(tmp_path) == []


def test_evaluate_model_without_its_task_net_asks_for_one(trained, tmp_path):
    model = publish.add(trained[0], "fmops.mine", tmp_path)
    with pytest.raises(UserError, match=r"fmops\.mine.* comes without its task net\. Give"):
        evaluated((model, trained[1]), tmp_path)


def test_evaluate_other_sizes_and_data(trained, tmp_path):
    record = evaluated(trained, tmp_path, "sizes=[5,20]", "dataset.n_points=100")
    sizes = {name.split("/")[1] for name in record.metrics if name.endswith("matched/accuracy")}
    assert sizes == {"m5", "m8", "m20"}
    assert record.config["dataset"]["n_points"] == 100
    assert record.config["dataset"]["classes"] == ["chair", "vase", "lamp"]


@pytest.mark.parametrize("change", ["test_noise_std=0.5", "test_corruption=drop_global-5"])
def test_evaluate_on_other_test_clouds_uses_the_same_data_and_net(trained, tmp_path, change):
    _, record = trained
    changed = evaluated(trained, tmp_path, change)
    key = "test/m8/generated/subset_distance"
    assert changed.metrics[key] != record.metrics[key]
    # A quarter of the points lies farther away.
    assert "drop" not in change or changed.metrics[key] > record.metrics[key]
    for name in ("dataset_fingerprint", "task_weights_sha256"):
        assert getattr(changed, name) == getattr(record, name)


def test_evaluate_threshold_changes_generated_points(trained, tmp_path):
    _, record = trained
    sparse = evaluated(trained, tmp_path, "sampler.threshold=0.02")
    keys = ("test/m8/generated/subset_distance", "test/m8/matrix/nonzero_percent")
    changed, same = keys
    assert sparse.metrics[changed] != record.metrics[changed]
    assert sparse.metrics[same] == record.metrics[same]
    assert sparse.config["sampler"]["threshold"] == 0.02


def test_evaluate_joint_run_uses_its_task_net(tmp_path):
    record = job(tmp_path / "run", "learn=joint")
    again = evaluated((tmp_path / "run", record), tmp_path)
    assert again.metrics == record.metrics
    assert type(load_net(tmp_path / "run")) is PointNetVanilla


@pytest.mark.parametrize(
    ("argument", "named"),
    [
        ("++sampler.tau_min=0.2", "sampler.tau_min must be 0.1.*got 0.2"),
        ("dataset.classes=[chair,vase]", "has 3 classes, which are not the 2 classes"),
        ("dataset.classes=[vase,chair,bed]", "classes, which are not the"),
        ("sizes=[33]", "at most sampler.m_max=32"),
    ],
)
def test_evaluate_mismatch_raises(trained, tmp_path, argument, named):
    with pytest.raises(UserError, match=named):
        evaluated(trained, tmp_path, argument)


def test_another_task_net_is_used_with_its_own_classes_only(trained, tmp_path):
    job(tmp_path / "task", "learn=task", "seed=5", "dataset.seed=0")
    other = f"weights={tmp_path}/task/weights.safetensors"
    record = evaluated(trained, tmp_path, other)
    assert record.task_weights_sha256 not in (None, trained[1].task_weights_sha256)
    swapped = ["sampler=fps", "dataset.classes=[vase,chair,bed]"]
    with pytest.raises(UserError, match="classes, which are not the"):
        job(tmp_path / "swapped", *swapped, other)


def test_net_of_other_parts_raises(tmp_path):
    task = ["task=segmentation", "task.net.points=[16,8]"]
    made = job(tmp_path / "cups", *task, "learn=task", "dataset.classes=[cup]")
    lamps = "dataset.classes=[lamp]"
    message = "3 parts, which are not the 3 parts of the data: vessel, handle, saucer .*label"
    with pytest.raises(UserError, match=message):
        job(tmp_path / "lamps", *task, lamps, "sampler=fps", f"weights={tmp_path}/cups")
    with pytest.raises(UserError, match=message):
        evaluated((tmp_path / "cups", made), tmp_path, lamps)


def test_trained_run_not_evaluable_raises(trained, tmp_path):
    with pytest.raises(UserError, match="no folder"):
        command_line([f"evaluate={tmp_path}/none"])
    with pytest.raises(UserError, match=r"evaluate: .*no run record"):
        command_line([f"evaluate={tmp_path}"])
    record = trained[1].plain()
    path = tmp_path / "result.json"
    for change, named in (
        ({"status": "interrupted"}, "was interrupted. Give a completed run"),
        ({"status": "failed"}, "failed. Give a completed run"),
        ({"files": {}}, "trained nothing"),
    ):
        path.write_text(json.dumps({**record, **change}))
        with pytest.raises(UserError, match=named):
            command_line([f"evaluate={tmp_path}"])
    with pytest.raises(UserError, match="give its run with evaluate=RUN"):
        job(tmp_path / "new", "learn=nothing", f"cache={trained[0].parent}/cache")


def test_evaluate_task_net_on_other_data(tmp_path):
    net = ["task/net=mfoldingnet", "task.net.fold_channels=[16,8]"]
    made = job(tmp_path / "made", "task=reconstruction", *net, "learn=task")
    folder = (tmp_path / "made", made)
    again = evaluated(folder, tmp_path / "same")
    assert again.metrics == made.metrics
    assert "fit" not in again.seconds
    assert not (tmp_path / "same" / "new" / "weights.safetensors").exists()
    more = evaluated(folder, tmp_path / "more", "dataset.n_points=90", "test_noise_std=0.01")
    assert more.config["task"]["net"]["n_points"] == 90
    assert more.score != made.score
    with pytest.raises(UserError, match="learn=nothing: has no effect"):
        evaluated(folder, tmp_path / "b", "learn=nothing")


def test_evaluate_autoencoder_more_points_raises(tmp_path):
    made = job(tmp_path / "made", "task=reconstruction", "sampler=mops")
    with pytest.raises(UserError, match=r"another net's weights: .*size mismatch"):
        evaluated((tmp_path / "made", made), tmp_path, "dataset.n_points=90")


def test_evaluate_task_net_with_its_classes(trained, tmp_path):
    folder, _ = trained
    classes = "dataset.classes=[bed,vase]"
    record = evaluated(trained, tmp_path, classes, "weights=auto", f"cache={folder.parent}/cache")
    assert record.class_names == ["bed", "vase"]


def test_evaluate_missing_weights_raises(trained, tmp_path):
    record = trained[1].plain()
    (tmp_path / "result.json").write_text(json.dumps(record))
    with pytest.raises(UserError, match=r"evaluate: .* cannot be loaded"):
        evaluated((tmp_path, record), tmp_path, "weights=null")


def test_settings_that_a_net_has_from_its_run_are_no_changed_settings():
    recorded = {
        "task.net.n_points": 1024,
        "task.net.k": 16,
        "task.net.sampler.m": 32,
        "task.net.sampler.m_max": 512,
        "task.net.sampler.seed": 0,
        "task.net.sampler.alpha": 30.0,
    }
    of_stages = {"m": 8, "m_max": 64, "seed": 5, "alpha": 1.0}
    net = {"n_points": 256, "k": 8, "sampler": of_stages}

    different = _changed_settings(recorded, net)

    assert different == ["task.net.k=16", "task.net.sampler.alpha=30.0"]
