import json

import pytest
import torch

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.run import run
from mops_lightning.zoo import weights
from tests.support.command_line import TINY


def train(folder, *arguments):
    overrides = [*TINY, f"cache={folder}/cache", *arguments]
    return run(compose(overrides), folder / f"run{len(list(folder.iterdir()))}", overrides)


def files(folder, pattern):
    return [weights.read(path) for path in sorted(folder.rglob(pattern))]


def test_a_task_net_can_be_trained_on_from_a_file_and_is_not_taken_for_a_new_one(tmp_path):
    train(tmp_path, "learn=task", "task=registration")
    (published,) = files(tmp_path, "cache/weights/*/weights.pt")
    first = tmp_path / "run0" / "weights.pt"
    record = train(
        tmp_path, "learn=task", "task=registration", f"weights={first}", "optimizer.lr=0"
    )
    assert record.notes["weights_loaded"] == published["sha256"]
    own, again = (weights.read(path)["state"] for path in sorted(tmp_path.glob("run*/weights.pt")))
    assert all(torch.equal(own[name], again[name]) for name in own)  # at a rate of 0 nothing moves
    assert len(files(tmp_path, "cache/weights/*/weights.pt")) == 1


def test_a_net_without_weights_takes_no_file(tmp_path):
    with pytest.raises(UserError, match=r"weights: icp.*got some.pt"):
        train(tmp_path, "task=registration", "task/net=icp", "sampler=fps", "weights=some.pt")


def test_a_resumed_run_from_given_weights_is_not_published_either(tmp_path):
    train(tmp_path, "learn=task", "task=registration")
    first = tmp_path / "run0" / "weights.pt"
    given = ["learn=task", "task=registration", f"weights={first}"]
    train(tmp_path, *given)
    for path in (tmp_path / "cache" / "weights").rglob("weights.pt"):
        path.unlink()
    train(tmp_path, *given, f"ckpt_path={sorted(tmp_path.glob('run*'))[-1]}")
    assert not files(tmp_path, "cache/weights/*/weights.pt")


def test_a_run_is_not_resumed_under_other_weights(tmp_path):
    task = ["learn=task", "task=registration"]
    train(tmp_path, *task)
    anew = tmp_path / "run0"
    given = f"weights={anew / 'weights.pt'}"
    train(tmp_path, *task, given)
    begun = tmp_path / "run2"
    for weights_, checkpoint in ((given, anew), ("weights=auto", begun)):
        with pytest.raises(UserError, match=r"of a run with other settings \(weights"):
            train(tmp_path, *task, weights_, f"ckpt_path={checkpoint}")


def test_training_that_goes_astray_fails_and_is_not_kept(tmp_path):
    with pytest.raises(UserError, match=r"rotation_error_deg is nan: .*diverged"):
        train(tmp_path, "learn=task", "task=registration", "optimizer.lr=1e30")
    assert not files(tmp_path, "**/weights.pt")
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
        (["~task.pairs"], r"task\.pairs cannot be None"),
        (["task.loss=null"], r"task\.loss cannot be None"),
        (["task.loss.translation_weight=-1"], r"task.loss.translation_weight must be .*got -1"),
        (["task.pairs.translation=inf"], r"task.pairs.translation must be .*got inf"),
        (["task.pairs.resample=32", "task.pairs.overlap=0.4", "m=24"], r"task.pairs.overlap"),
    ],
)
def test_mistakes_end_before_anything_is_trained_or_kept(settings, said, tmp_path):
    with pytest.raises(UserError, match=said):
        train(tmp_path, "task=registration", *settings)
    assert not files(tmp_path, "**/weights.pt")


def test_seeds_of_the_scored_pairs_do_not_train_the_net_anew(tmp_path):
    train(tmp_path, "task=registration", "sampler=fps")
    (first,) = files(tmp_path, "cache/weights/*/weights.pt")
    train(tmp_path, "task=registration", "sampler=fps", "task.pairs.test_seed=5")
    assert [one["sha256"] for one in files(tmp_path, "cache/weights/*/weights.pt")] == [
        first["sha256"]
    ]
