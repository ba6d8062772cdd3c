import numpy as np
import pytest
import torch
from filelock import FileLock

from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY
from mops_lightning.records import run_record
from mops_lightning.training.checkpoint import CHECKPOINT, THREADS, read_sealed
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.pretrain import cache_folder
from mops_lightning.training.run.run import run
from mops_lightning.zoo import weights
from tests.support import command_line
from tests.support.command_line import SMALL_PCRNET, TINY, TINY_ANY_DATA, call, job, start
from tests.support.hdf5 import write_file

CACHED = f"cache/weights/*/{weights.FILE}"


def train(folder, *arguments):
    """Run in the next folder: run0, and with its cache and each other run beside it run1, …"""
    number = len(list(folder.iterdir()))
    return job(folder / f"run{number}", *arguments)


def files(folder, pattern):
    return [weights.read(path) for path in sorted(folder.rglob(pattern))]


def states(folder, pattern):
    return [content["state"] for content in files(folder, pattern)]


def test_task_net_from_file_is_not_published(tmp_path, capsys):
    task = ["learn=task", *SMALL_PCRNET]
    cfg = compose([*TINY, f"cache={tmp_path}/cache", *task])
    dataset = build(cfg.dataset, "dataset")
    folder = cache_folder(cfg, dataset)
    folder.mkdir(parents=True)
    (folder / f"{TEMPORARY}left by a kill.pt").touch()

    train(tmp_path, *task)

    assert [path.name for path in folder.iterdir()] == [weights.FILE]

    given = [
        *task,
        f"weights={tmp_path / 'run1'}",  # a run's folder means its weights file
        "task.net.iterations=3",
        "optimizer.lr=1e-30",
    ]
    record = train(tmp_path, *given)

    cached = weights.read(folder / weights.FILE)
    assert record.weights_loaded == cached["sha256"]
    assert "was trained with task.net.iterations=2, not as here." in capsys.readouterr().out
    own, again = states(tmp_path, "run*/weights.safetensors")
    torch.testing.assert_close(again, own, rtol=0, atol=1e-20)  # at this rate nothing moves
    assert len(files(tmp_path, CACHED)) == 1

    (folder / weights.FILE).unlink()
    train(tmp_path, *given, f"ckpt_path={tmp_path / 'run2'}")

    assert not files(tmp_path, CACHED)


def test_task_net_is_pretrained_by_its_own_optimizer(tmp_path):
    by_run = train(tmp_path, *SMALL_PCRNET, "sampler=fps", "pretrain.lr=1e-30")

    train(tmp_path, *SMALL_PCRNET, "learn=task", "optimizer.lr=1e-30")

    (alone,) = files(tmp_path, "run*/weights.safetensors")
    assert by_run.task_weights_sha256 == alone["sha256"]


def test_cached_task_net_is_that_of_the_same_data(tmp_path):
    settings = [*SMALL_PCRNET, "sampler=fps"]

    first = train(tmp_path, *settings, "dataset.seed=0")
    second = train(tmp_path, *settings, "dataset.seed=1")
    again = train(tmp_path, *settings, "dataset.seed=0")

    assert second.task_weights_sha256 != first.task_weights_sha256
    assert again.task_weights_sha256 == first.task_weights_sha256
    assert len(files(tmp_path, CACHED)) == 2


def test_pretraining_starts_from_given_weights(tmp_path):
    train(tmp_path, "learn=task", *SMALL_PCRNET)
    own = [*SMALL_PCRNET, f"pretrain_from={tmp_path}/run0", "sampler=fps", "pretrain.lr=1e-30"]

    train(tmp_path, *own)

    first, second = states(tmp_path, CACHED)
    torch.testing.assert_close(first, second, rtol=0, atol=1e-20)  # at this rate nothing moves
    with pytest.raises(UserError, match="pretrain_from: no file"):
        train(tmp_path, *own, "pretrain_from=nowhere/net.pt")


def test_resume_other_weights_raises(tmp_path):
    task = ["learn=task", *SMALL_PCRNET]
    train(tmp_path, *task)
    anew = tmp_path / "run0"
    given = f"weights={anew / 'weights.safetensors'}"
    train(tmp_path, *task, given)
    begun = tmp_path / "run2"
    said = r"from a run with other settings \(weights"

    with pytest.raises(UserError, match=said):
        train(tmp_path, *task, given, f"ckpt_path={anew}")
    with pytest.raises(UserError, match=said):
        train(tmp_path, *task, "weights=auto", f"ckpt_path={begun}")


def test_resume_with_other_clouds_held_out_raises(tmp_path):
    task = ["learn=task", *SMALL_PCRNET]
    train(tmp_path, *task, "val_fraction=0.25")

    with pytest.raises(UserError, match=r"other settings \(val_fraction\); val_fraction is 0\.5 "):
        train(tmp_path, *task, "val_fraction=0.5", f"ckpt_path={tmp_path / 'run0'}")


def test_resume_on_changed_clouds_raises(tmp_path):
    def trained(seed, *more):
        labels = np.arange(4) % 2
        for split in ("train", "test"):
            random = np.random.default_rng(seed)
            points = random.random((4, 64, 3), np.float32)
            write_file(tmp_path / f"{split}.h5", data=points, label=labels)
        given = [
            *TINY_ANY_DATA,
            *SMALL_PCRNET,
            "learn=task",
            "dataset=hdf5",
            f"dataset.root={tmp_path}",
            f"cache={tmp_path}/cache",
            *more,
        ]
        run(compose(given), tmp_path / str(seed), given)

    trained(0)
    with pytest.raises(UserError, match=r"from a run with other settings \(dataset"):
        trained(1, f"ckpt_path={tmp_path}/0")


def test_diverged_training_fails_without_weights(tmp_path):
    with pytest.raises(UserError, match=r"training diverged: the loss is not finite .*No weights"):
        train(tmp_path, "learn=task", *SMALL_PCRNET, "optimizer.lr=1e18")

    assert not files(tmp_path, "**/weights.safetensors")
    assert run_record.read(tmp_path / "run0").status == "failed"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            ["task/net=pointnet"],
            r"task\.net must take \(source, target\).*PointNetVanilla.*\(points\)",
        ),
        (["task.net=null"], r"task.net cannot be removed"),
        (["task.resample=0"], r"task.resample must be .*got 0"),
        (["task.resample=16", "m=24"], r"task.resample"),
        (
            ["sampler=pose", "sampler.m_max=16"],
            r"sampler=pose learns residuals of scans, which only task=icp knows; got "
            r"task=registration\. Choose task=icp or another sampler\.",
        ),
    ],
)
def test_mistake_fails_before_pretraining(settings, said, tmp_path):
    with pytest.raises(UserError, match=said):
        train(tmp_path, "task=registration", *settings)
    assert not files(tmp_path, "**/weights.safetensors")


def test_damaged_cache_raises_and_names_the_file(tmp_path):
    settings = [*SMALL_PCRNET, "sampler=fps", "epochs.task=2"]
    train(tmp_path, *settings)
    (path,) = tmp_path.glob("cache/weights/*/weights.safetensors")
    checkpoint = path.parent / "checkpoints" / "last.ckpt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"^weights: .*/weights\.safetensors is damaged"):
        train(tmp_path, *settings)

    path.unlink()
    content = torch.load(checkpoint, weights_only=True)
    content["optimizer_states"] = [{"state": {}}]
    torch.save(content, checkpoint)
    with pytest.raises(UserError, match=r"^ckpt_path: .*/last\.ckpt is damaged"):
        train(tmp_path, *settings)


def test_same_task_net_in_two_processes_is_trained_once(tmp_path):
    overrides = [*command_line.TINY_WITH_PICTURES, "sampler=fps", f"cache={tmp_path}/cache"]
    cfg = compose(overrides)
    dataset = build(cfg.dataset, "dataset")
    folder = cache_folder(cfg, dataset)
    folder.parent.mkdir(parents=True)
    lock = folder.parent / f"{folder.name}.lock"

    with FileLock(lock):
        other = start([*overrides, "hydra.run.dir=a"], tmp_path)
        wait_for(other, f"({lock})")
    status, here, err = call([*overrides, "hydra.run.dir=b"], tmp_path)
    there, other_err = other.communicate(timeout=240)

    assert status == 0, err
    assert (other.returncode, other_err) == (0, "")
    printed = here + there
    assert printed.count("training it first") == 1
    first = run_record.read(tmp_path / "a")
    second = run_record.read(tmp_path / "b")
    assert first.task_weights_sha256 == second.task_weights_sha256


def wait_for(process, lock):
    """Read what a process prints until it waits for another one at a lock."""
    for line in iter(process.stdout.readline, ""):
        if "Waiting for another process" in line and lock in line:
            return
    raise AssertionError("the process ended without waiting")


def test_resume_with_fewer_epochs_than_done_raises(tmp_path):
    task = ["learn=task", *SMALL_PCRNET]
    train(tmp_path, *task, "trainer.max_epochs=3")
    checkpoint = f"ckpt_path={tmp_path / 'run0'}"

    with pytest.raises(UserError, match=r"max_epochs must be at least 3.*last\.ckpt, got 2"):
        train(tmp_path, *task, "trainer.max_epochs=2", checkpoint)
    same = train(tmp_path, *task, "trainer.max_epochs=3", checkpoint)
    longer = train(tmp_path, *task, "trainer.max_epochs=4", checkpoint)

    assert not same.lengthened
    assert longer.lengthened
    assert len(files(tmp_path, CACHED)) == 1  # not of the longer one


def test_shortened_pretraining_says_so_before_it_starts(tmp_path, capsys):
    train(tmp_path, "sampler=fps", "+trainer.max_steps=1")

    said = "training it first, 1 epoch, shortened by trainer.max_steps=1."
    assert said in capsys.readouterr().out


def test_resumed_pretraining_does_not_warn_about_its_folder(tmp_path, capsys, recwarn):
    train(tmp_path, "sampler=fps")
    (weights_file,) = tmp_path.glob("cache/weights/*/weights.safetensors")
    weights_file.unlink()

    train(tmp_path, "sampler=fps")

    assert capsys.readouterr().out.count("training it first, 1 epoch.") == 2
    for warning in recwarn:
        assert "not empty" not in str(warning.message)


def test_resumed_pretraining_notices_another_number_of_threads(tmp_path, capsys):
    settings = [*SMALL_PCRNET, "sampler=fps"]
    train(tmp_path, *settings)
    (weights_file,) = tmp_path.glob("cache/weights/*/weights.safetensors")
    said = "this training began with OMP_NUM_THREADS=3 and goes on with"

    weights_file.unlink()
    train(tmp_path, *settings)
    assert said not in capsys.readouterr().out

    checkpoint = weights_file.parent / "checkpoints" / CHECKPOINT
    content = read_sealed(checkpoint)
    content[THREADS] = 3
    AtomicCheckpointIO().save_checkpoint(content, checkpoint)
    weights_file.unlink()
    train(tmp_path, *settings)
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("mistake", ["+pretrain.betas=7", "pretrain.schedule.warmup=7"])
def test_wrong_optimizer_of_a_cached_task_net_is_an_error(mistake, tmp_path):
    train(tmp_path, "learn=task", *SMALL_PCRNET)
    assert len(files(tmp_path, CACHED)) == 1

    with pytest.raises(UserError, match=r"^pretrain[.:]"):
        train(tmp_path, *SMALL_PCRNET, "sampler=fps", mistake)


def test_training_of_a_task_net_starts_from_given_weights(tmp_path):
    task = ["learn=task", *SMALL_PCRNET]
    train(tmp_path, *task)
    start = f"pretrain_from={tmp_path}/run0"

    record = train(tmp_path, *task, start, "optimizer.lr=1e-30")

    first, second = states(tmp_path, "run*/weights.safetensors")
    torch.testing.assert_close(first, second, rtol=0, atol=1e-20)  # at this rate nothing moves
    assert record.weights_loaded == weights.read(tmp_path / "run0" / weights.FILE)["sha256"]
    other = "task.net.feature_channels=[8,16]"
    with pytest.raises(UserError, match=r"^pretrain_from: .* holds another net's weights"):
        train(tmp_path, *task, start, other)


def test_cache_is_below_the_home_folder_and_names_task_net_and_data(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    cfg = compose([*TINY, "cache='~/mine'", "learn=task"])

    folder = cache_folder(cfg, build(cfg.dataset, "dataset"))

    assert folder.parent == tmp_path / "mine" / "weights"
    assert folder.name.startswith("classification-pointnet-shapes-")
    assert len(folder.name.rpartition("-")[2]) == 12
