"""The real command line, as a user types it."""

import json
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
import torch

from mops_lightning.records import run_record
from mops_lightning.zoo import weights
from tests.support.command_line import TINY_WITH_PICTURES, call, call_anew, runs, start


@pytest.fixture(scope="module")
def main_job(tmp_path_factory):
    """The main job, small, once: its folder, its run's folder and what it printed."""
    folder = tmp_path_factory.mktemp("main")
    status, out, err = call_anew(TINY_WITH_PICTURES, folder)
    assert status == 0, err
    (run,) = runs(folder)
    return folder, run, out, err


def test_the_main_job_pretrains_trains_tests_and_says_where_all_lies(main_job):
    folder, run, out, err = main_job
    assert "training it first" in out
    for word in ("random", "voxel", "fps", "generated", "matched", "completed", "accuracy"):
        assert word in out
    last = out.strip().splitlines()[-1]
    for name in ("result.json", "checkpoints/last.ckpt", "pictures", "tensorboard"):
        assert name in last
        assert (run / name).exists()
    assert err == "", "nothing but the result is said"


def test_the_main_job_leaves_a_complete_record(main_job):
    folder, run, *_ = main_job
    record = run_record.read(run)
    assert record["status"] == "completed"
    assert record["overrides"] == TINY_WITH_PICTURES
    for readout in ("random", "voxel", "fps", "generated", "matched", "completed", "full"):
        assert 0 <= record["metrics"][f"test/{readout}/accuracy"] <= 1
    assert record["score"] == record["metrics"]["test/generated/accuracy"]
    assert record["seconds"]["total"] > record["seconds"]["fit"] > 0
    assert record["device"] == "cpu"
    assert record["notes"]["test_clouds"] == 3 * len(record["config"]["dataset"]["classes"])


def test_weights_pictures_and_curves_are_real_files(main_job):
    folder, run, *_ = main_job
    content = weights.read(run / "weights.pt")
    assert content["state"]["queries.weight"].shape[0] == 8
    for name in ("clouds.png", "matrix.png"):
        assert (run / "pictures" / name).read_bytes().startswith(b"\x89PNG")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    tags: dict[str, set[str]] = {}
    for path in (run / "tensorboard").rglob("events*"):
        accumulator = EventAccumulator(str(path))
        accumulator.Reload()
        for kind, names in accumulator.Tags().items():
            if isinstance(names, list):
                tags.setdefault(kind, set()).update(names)
    for tag in ("train/loss/cross_entropy", "train/loss/subset", "train/tau", "lr-Adam"):
        assert tag in tags["scalars"]
    assert "test/generated/accuracy" in tags["scalars"]
    assert "val/matched/accuracy" in tags["scalars"]
    assert {"clouds", "matrix"} <= tags["images"]
    assert any(tag.startswith("generated/0_") for tag in tags["tensors"])
    assert any("hparams" in tag for kind in tags.values() for tag in kind)


def test_the_cached_task_net_serves_the_next_run(main_job):
    folder, *_ = main_job
    status, out, err = call([*TINY_WITH_PICTURES, "sampler=fps", "m=4"], folder)
    assert status == 0, err
    assert "training it first" not in out
    record = run_record.read(runs(folder)[-1 if "fps" in str(runs(folder)[-1]) else 0])
    assert record["status"] == "completed"
    assert "test/sampled/accuracy" in record["metrics"]
    assert "weights" not in record["files"]


def test_a_sweep_leaves_one_record_per_job_and_goes_on_after_a_failure(main_job):
    folder, *_ = main_job
    fixed = ["out=sweep", "hydra.sweep.dir=sweep/cells"]
    status, out, err = call(
        ["-m", *TINY_WITH_PICTURES, "sampler=random", "m=4,65,8", *fixed], folder
    )
    assert status == 1
    assert "sweep/cells/1 failed: m must be at most dataset.n_points=64, got m=65" in out
    assert "3 cells: 2 completed, 1 failed; in sweep/cells" in out
    assert "Traceback" not in out + err
    found = sorted((folder / "sweep").rglob("result.json"))
    assert [json.loads(p.read_text())["config"]["m"] for p in found] == [4, 8]
    # Only the cells of this start count, not what an earlier one has left.
    status, out, err = call(["-m", *TINY_WITH_PICTURES, "sampler=random", "m=4", *fixed], folder)
    assert status == 0, out + err
    assert "1 cells: 1 completed; in sweep/cells" in out


def test_joint_training_starts_from_the_pretrained_task(main_job):
    folder, *_ = main_job
    status, out, err = call([*TINY_WITH_PICTURES, "learn=joint", "out=joint"], folder)
    assert status == 0, err
    assert "training it first" not in out
    (path,) = (folder / "joint").rglob("result.json")
    before = next((folder / "cache" / "weights").rglob("weights.pt"))
    after = weights.read(path.parent / "task_weights.pt")
    assert after["sha256"] != weights.read(before)["sha256"]


def test_registration_pretrains_trains_jointly_tests_and_is_evaluated_under_icp(tmp_path):
    settings = [
        *TINY_WITH_PICTURES,
        "task=registration",
        "sampler=fmops",
        "sampler.m_max=16",
        "pictures=1",
    ]
    status, out, err = call([*settings, "learn=joint"], tmp_path)
    assert status == 0, err
    assert "training it first" in out
    assert "registration by pcrnet, shapes, rotation error (°), test" in out
    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert 0 < record["metrics"]["test/m16/matched/rotation_error_p90_deg"] < 180
    assert record["score"] == record["metrics"]["test/m8/generated/rotation_error_deg"]
    assert {path.name for path in (run / "pictures").iterdir()} == {
        "clouds.npz",
        "clouds.png",
        "matrix.png",
        "pairs.png",
    }
    assert (run / "task_weights.pt").is_file()
    status, out, err = call(
        [f"evaluate={run}", "task/net=icp", "task.pairs.overlap=0.8", "pictures=0"], tmp_path
    )
    assert status == 0, err
    assert "registration by icp" in out
    status, _, err = call(["task=registration", "task/net=icp", *TINY_WITH_PICTURES], tmp_path)
    assert status == 2
    assert "learn=sampler: ICP has no weights" in err


def test_help_lists_subcommands_groups_and_keys(tmp_path):
    status, out, err = call_anew(["--help"], tmp_path)
    assert (status, err) == (0, "")
    for word in ("sampler:", "mops", "val_fraction", "ckpt_path", "python -m mops_lightning -m"):
        assert word in out
    assert out.index("report ") < out.index("downsample ") < out.index("sampler:")


@pytest.mark.parametrize("arguments", [["--help"], ["report", "--help"], ["downsample", "--help"]])
def test_help_imports_no_torch(arguments):
    code = f"""
import sys
from mops_lightning.cli.main import main
sys.argv[1:] = {arguments}
try:
    main()
finally:
    print("torch" in sys.modules, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "False\n"


def test_cfg_job_shows_the_config(tmp_path):
    status, out, err = call(["--cfg", "job", "m=64"], tmp_path)
    assert (status, err) == (0, "")
    assert "m: 64" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sampler.alhpa=3"], "sampler.alpha"),
        (["sampler=mosp"], "mops"),
        (["task=registration", "task/lss=quaternion"], "Did you mean 'task/loss'"),
        (["sampler.log=2"], "sampler.log: no such setting"),
        (["sampler.feature_channels=[8]"], "write +sampler.feature_channels=..."),
        (["learn=smapler"], "Did you mean 'sampler'"),
        (["m=4096"], "dataset.n_points=4096"),
        (["trainer=gpu", *TINY_WITH_PICTURES[1:]], "Try trainer=auto or trainer=cpu"),
        (["m=abc"], "m must be a whole number"),
        (["dataset=modelnet40", "dataset.root=nowhere"], "dataset.root"),
        (["dataset.classes=[chiar]"], "chair"),
        (["ckpt_path=last", *TINY_WITH_PICTURES], "ckpt_path=last"),
        ([*TINY_WITH_PICTURES, "dataset.classes=[chair]"], "num_classes must be at least 2"),
        (["weights=nowhere.pt", *TINY_WITH_PICTURES], "no file nowhere.pt"),
    ],
)
def test_mistakes_end_in_one_clear_error(arguments, said, tmp_path):
    status, _, err = call(arguments, tmp_path)
    assert status == 2
    assert said in err
    assert "Traceback" not in err
    assert err.startswith("mops_lightning: ")
    assert len(err.strip().splitlines()) == 1


def test_a_failed_run_leaves_a_record_that_says_why(tmp_path):
    root = tmp_path / "broken"
    root.mkdir()
    (root / "shape_names.txt").write_text("a\nb\n")
    for split in ("train", "test"):
        (root / f"{split}_files.txt").write_text(f"ply_data_{split}0.h5\n")
        with h5py.File(root / f"ply_data_{split}0.h5", "w") as file:
            file["data"] = np.zeros((4, 32, 3), np.float32)
            file["label"] = np.zeros((4, 1), np.uint8)
    path = root / "ply_data_test0.h5"
    path.write_bytes(path.read_bytes()[:700])
    settings = ["dataset=modelnet40", "dataset.root=broken", "dataset.n_points=32", "m=4"]
    status, out, err = call(settings, tmp_path)
    assert status == 2
    assert "ply_data_test0.h5" in err
    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert record["status"] == "failed"
    assert "ply_data_test0.h5" in record["error"]


def test_real_modelnet40_runs_from_any_folder(real_data, tmp_path):
    root = (real_data / "modelnet40_hdf5_1024").resolve()
    if not root.is_dir():
        pytest.skip(f"no modelnet40_hdf5_1024 in {real_data}")
    settings = [s for s in TINY_WITH_PICTURES if "per_class" not in s]
    data = ["dataset=modelnet40", f"dataset.root={root}", "dataset.classes=[cup,bowl]"]
    status, out, err = call([*settings, *data, "sampler.alpha=10", "sampler.tau_min=0.2"], tmp_path)
    assert status == 0, err
    (run,) = runs(tmp_path)
    notes = run_record.read(run)["notes"]
    assert (notes["train_clouds"], notes["test_clouds"]) == (79 + 64, 20 + 20)


def test_a_folder_of_meshes_runs(tmp_path):
    import trimesh

    for name, mesh in (("ball", trimesh.creation.icosphere()), ("box", trimesh.creation.box())):
        for split, number in (("train", 9), ("test", 2)):
            folder = tmp_path / "mine" / name / split
            folder.mkdir(parents=True)
            for i in range(number):
                mesh.export(folder / f"{i}.off")
    settings = [s for s in TINY_WITH_PICTURES if "per_class" not in s]
    status, out, err = call([*settings, "dataset=meshes", "dataset.root=mine"], tmp_path)
    assert status == 0, err
    (run,) = runs(tmp_path)
    assert run_record.read(run)["notes"]["skipped_meshes"] == 0


def test_another_net_s_weights_are_refused(main_job):
    folder, run, *_ = main_job
    other = next((folder / "cache" / "weights").rglob("weights.pt"))
    settings = [
        *TINY_WITH_PICTURES,
        f"weights={other}",
        "dataset.classes=[chair,table]",
        "out=other",
    ]
    status, out, err = call(settings, folder)
    assert status == 2
    assert "holds another net's weights" in err


def final_state(run):
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


LONGER = [
    *TINY_WITH_PICTURES[:1],
    "trainer.max_epochs=6",
    *TINY_WITH_PICTURES[2:],
    "dataset.train_per_class=12",
]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    status, out, err = call(LONGER, folder)
    assert status == 0, err
    (run,) = runs(folder)
    return folder, final_state(run)


@pytest.mark.parametrize(
    ("number", "left"), [(signal.SIGINT, "interrupted"), (signal.SIGKILL, "running")]
)
def test_a_run_stopped_in_mid_epoch_resumes_to_the_same_weights(unbroken, number, left):
    folder, want = unbroken
    out = f"stopped-{left}"
    process = start([*LONGER, f"out={out}"], folder)
    for line in process.stdout:
        if line.startswith("epoch 2/"):
            break
    time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    (run,) = (path.parent for path in (folder / out).rglob("result.json"))
    assert run_record.read(run)["status"] == left
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert "ckpt_path=" in err
        assert "Traceback" not in err
    status, _, err = call([*LONGER, f"out={out}", "ckpt_path=last"], folder)
    assert status == 0, err
    (resumed,) = (path.parent for path in (folder / out).rglob("result.json") if path.parent != run)
    assert run_record.read(resumed)["notes"]["resumed_from"] == str(
        (run / "checkpoints" / "last.ckpt").relative_to(folder)
    )
    got = final_state(resumed)
    assert got.keys() == want.keys()
    different = [name for name in want if not torch.equal(got[name], want[name])]
    assert different == []


def test_a_checkpoint_of_other_settings_is_refused(main_job):
    folder, run, *_ = main_job
    path = run.relative_to(folder)
    settings = [s if s != "m=8" else "m=4" for s in TINY_WITH_PICTURES]
    status, out, err = call([*settings, f"ckpt_path={path}", "out=wrong"], folder)
    assert status == 2
    assert "other settings (sampler" in err


def test_one_net_for_many_sizes_is_tested_at_once_and_evaluated_anew(main_job):
    folder, *_ = main_job
    status, out, err = call([*TINY_WITH_PICTURES, "sampler=fmops", "sampler.m_max=32"], folder)
    assert status == 0, err
    for word in ("m=8", "m=16", "m=32", "fmops completed", "all points"):
        assert word in out
    run = next(path for path in runs(folder) if path.parent.name == "fmops-m32")
    before = run_record.read(run)
    status, out, err = call([f"evaluate={run}", "sizes=[3,16]", "pictures=0"], folder)
    assert status == 0, err
    again = next(path for path in runs(folder) if path.parent.name == "fmops-m32-evaluated")
    after = run_record.read(again)
    name = "test/m16/completed/accuracy"
    assert after["metrics"][name] == before["metrics"][name]
    assert "test/m3/matched/accuracy" in after["metrics"]
    status, _, err = call([f"evaluate={run}", "sampler.tau_min=0.5"], folder)
    assert status == 2
    assert err.count("\n") == 1
    assert "sampler.tau_min is 0.5 here and was 0.1" in err
