import pytest
import torch

from mops_lightning import weights
from mops_lightning.config import compose
from mops_lightning.errors import UserError
from mops_lightning.run import run
from tests.test_evaluate import TINY


def train(folder, *arguments):
    overrides = [*TINY, f"cache={folder}/cache", *arguments]
    return run(compose(overrides), folder / f"run{len(list(folder.iterdir()))}", overrides)


def files(folder, pattern):
    return [weights.load(path) for path in sorted(folder.rglob(pattern))]


def test_a_task_net_can_be_trained_on_from_a_file_and_is_not_taken_for_a_new_one(tmp_path):
    train(tmp_path, "learn=task", "task=registration")
    (published,) = files(tmp_path, "cache/weights/*/weights.pt")
    first = tmp_path / "run0" / "weights.pt"
    record = train(
        tmp_path, "learn=task", "task=registration", f"weights={first}", "optimizer.optimizer.lr=0"
    )
    assert record["notes"]["weights_loaded"] == published["sha256"]
    own, again = (weights.load(path)["state"] for path in sorted(tmp_path.glob("run*/weights.pt")))
    assert all(torch.equal(own[name], again[name]) for name in own)  # at a rate of 0 nothing moves
    assert len(files(tmp_path, "cache/weights/*/weights.pt")) == 1


def test_a_net_without_weights_takes_no_file(tmp_path):
    with pytest.raises(UserError, match=r"weights: icp has none to load, got some.pt"):
        train(tmp_path, "task=registration", "task/net=icp", "sampler=fps", "weights=some.pt")
