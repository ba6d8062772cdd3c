import json

import numpy as np
import pytest
import torch
from filelock import FileLock

from mops_lightning.config.build import build
from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY
from mops_lightning.training.run.pretrain import cache_folder
from mops_lightning.training.run.run import run
from mops_lightning.zoo import weights
from tests.support import command_line
from tests.support.command_line import SMALL_PCRNET, TINY, TINY_ANY_DATA, call, job, start
from tests.support.hdf5 import write_file


def train(folder, *arguments):
    return job(folder / f"run{len(list(folder.iterdir()))}", *arguments)


def files(folder, pattern):
    return [weights.read(path) for path in sorted(folder.rglob(pattern))]


def test_task_net_from_file_is_not_published(tmp_path, capsys):
    cfg = compose([*TINY, f"cache={tmp_path}/cache", "learn=task", *SMALL_PCRNET])
    folder = cache_folder(cfg, build(cfg.dataset, "dataset"))
    folder.mkdir(parents=True)
    (folder / f"{TEMPORARY}left by a kill.pt").touch()
    train(tmp_path, "learn=task", *SMALL_PCRNET)
    assert [path.name for path in folder.iterdir()] == [weights.FILE]
    # A run's folder means its weights file.
    given = ["learn=task", *SMALL_PCRNET, f"weights={tmp_path / 'run1'}", "task.net.iterations=3"]
    record = train(tmp_path, *given, "optimizer.lr=1e-30")
    assert record.weights_loaded == weights.read(folder / weights.FILE)["sha256"]
    assert "was trained with task.net.iterations=2, not as here." in capsys.readouterr().out
    own, again = (one["state"] for one in files(tmp_path, "run*/weights.safetensors"))
    torch.testing.assert_close(again, own, rtol=0, atol=1e-20)  # at this rate nothing moves
    assert len(files(tmp_path, "cache/weights/*/weights.safetensors")) == 1
    (folder / weights.FILE).unlink()
    train(tmp_path, *given, "optimizer.lr=1e-30", f"ckpt_path={tmp_path / 'run2'}")
    assert not files(tmp_path, "cache/weights/*/weights.safetensors")


def test_task_net_is_pretrained_by_its_own_optimizer(tmp_path):
    by_run = train(tmp_path, *SMALL_PCRNET, "sampler=fps", "pretrain.lr=1e-30")
    train(tmp_path, *SMALL_PCRNET, "learn=task", "optimizer.lr=1e-30")
    (alone,) = files(tmp_path, "run*/weights.safetensors")
    assert by_run.task_weights_sha256 == alone["sha256"]


def test_cached_task_net_is_that_of_the_same_data(tmp_path):
    settings = [*SMALL_PCRNET, "sampler=fps"]
    first = train(tmp_path, *settings, "dataset.seed=0").task_weights_sha256

    second = train(tmp_path, *settings, "dataset.seed=1").task_weights_sha256

    assert second != first
    assert train(tmp_path, *settings, "dataset.seed=0").task_weights_sha256 == first
    assert len(files(tmp_path, "cache/weights/*/weights.safetensors")) == 2


def test_pretraining_starts_from_given_weights(tmp_path):
    train(tmp_path, "learn=task", *SMALL_PCRNET)
    own = [*SMALL_PCRNET, f"pretrain_from={tmp_path}/run0", "sampler=fps", "pretrain.lr=1e-30"]
    train(tmp_path, *own)
    first, second = (one["state"] for one in files(tmp_path, "cache/weights/*/weights.safetensors"))
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
    for weights_, checkpoint in ((given, anew), ("weights=auto", begun)):
        with pytest.raises(UserError, match=r"from a run with other settings \(weights"):
            train(tmp_path, *task, weights_, f"ckpt_path={checkpoint}")


def test_resume_with_other_clouds_held_out_raises(tmp_path):
    task = ["learn=task", *SMALL_PCRNET]
    train(tmp_path, *task, "val_fraction=0.25")

    with pytest.raises(UserError, match=r"other settings \(val_fraction\); val_fraction is 0\.5 "):
        train(tmp_path, *task, "val_fraction=0.5", f"ckpt_path={tmp_path / 'run0'}")


def test_resume_on_changed_clouds_raises(tmp_path):
    def trained(seed, *more):
        for split in ("train", "test"):
            points = np.random.default_rng(seed).random((4, 64, 3), np.float32)
            write_file(tmp_path / f"{split}.h5", data=points, label=np.arange(4) % 2)
        data = ["dataset=hdf5", f"dataset.root={tmp_path}", f"cache={tmp_path}/cache"]
        given = [*TINY_ANY_DATA, *SMALL_PCRNET, "learn=task", *data, *more]
        run(compose(given), tmp_path / str(seed), given)

    trained(0)
    with pytest.raises(UserError, match=r"from a run with other settings \(dataset"):
        trained(1, f"ckpt_path={tmp_path}/0")


def test_diverged_training_fails_without_weights(tmp_path):
    with pytest.raises(UserError, match=r"training diverged: the loss is not finite .*No weights"):
        train(tmp_path, "learn=task", *SMALL_PCRNET, "optimizer.lr=1e18")
    assert not files(tmp_path, "**/weights.safetensors")
    record = json.loads((tmp_path / "run0" / "result.json").read_text())
    assert record["status"] == "failed"


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
    torch.save({**content, "optimizer_states": [{"state": {}}]}, checkpoint)
    with pytest.raises(UserError, match=r"^ckpt_path: .*/last\.ckpt is damaged"):
        train(tmp_path, *settings)


def test_same_task_net_in_two_processes_is_trained_once(tmp_path):
    overrides = [*command_line.TINY_WITH_PICTURES, "sampler=fps", f"cache={tmp_path}/cache"]
    cfg = compose(overrides)
    folder = cache_folder(cfg, build(cfg.dataset, "dataset"))
    folder.parent.mkdir(parents=True)
    lock = folder.parent / f"{folder.name}.lock"
    with FileLock(lock):
        other = start([*overrides, "hydra.run.dir=a"], tmp_path)
        lines = iter(other.stdout.readline, "")
        assert any("Waiting for another process" in line and str(lock) in line for line in lines)
    status, here, err = call([*overrides, "hydra.run.dir=b"], tmp_path)
    there, other_err = other.communicate(timeout=240)
    assert (status, other.returncode, other_err) == (0, 0, ""), err + other_err
    assert (here + there).count("training it first") == 1
    records = [json.loads((tmp_path / one / "result.json").read_text()) for one in "ab"]
    first, second = (record["task_weights_sha256"] for record in records)
    assert first == second


def test_resume_with_fewer_epochs_than_done_raises(tmp_path):
    task = ["learn=task", *SMALL_PCRNET]
    train(tmp_path, *task, "trainer.max_epochs=3")
    checkpoint = f"ckpt_path={tmp_path / 'run0'}"
    with pytest.raises(UserError, match=r"max_epochs must be at least 3.*last\.ckpt, got 2"):
        train(tmp_path, *task, "trainer.max_epochs=2", checkpoint)
    same = train(tmp_path, *task, "trainer.max_epochs=3", checkpoint)
    longer = train(tmp_path, *task, "trainer.max_epochs=4", checkpoint)
    assert [one.lengthened for one in (same, longer)] == [False, True]
    assert len(files(tmp_path, "cache/weights/*/weights.safetensors")) == 1  # not of the longer one


def test_resumed_pretraining_does_not_warn_about_its_folder(tmp_path, capsys, recwarn):
    train(tmp_path, "sampler=fps")
    (weights_file,) = tmp_path.glob("cache/weights/*/weights.safetensors")
    weights_file.unlink()
    train(tmp_path, "sampler=fps")
    assert capsys.readouterr().out.count("training it first, 1 epoch.") == 2
    assert not [one for one in recwarn if "not empty" in str(one.message)]


@pytest.mark.parametrize("mistake", ["+pretrain.betas=7", "pretrain.schedule.warmup=7"])
def test_wrong_optimizer_of_a_cached_task_net_is_an_error(mistake, tmp_path):
    train(tmp_path, "learn=task", *SMALL_PCRNET)
    assert len(files(tmp_path, "cache/weights/*/weights.safetensors")) == 1

    with pytest.raises(UserError, match=r"^pretrain[.:]"):
        train(tmp_path, *SMALL_PCRNET, "sampler=fps", mistake)
