"""The table of the task net's predictions for all points, and the file that keeps it."""

import torch

from mops_lightning.filesystem import TEMPORARY
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.full_predictions import full_predictions
from tests.support.training import small_dataset

CPU = torch.device("cpu")


def predictions(tmp_path, seed=0, clouds=None):
    torch.manual_seed(seed)
    task = Classification(PointNetVanilla(3), 3).eval()
    clouds = clouds or small_dataset().train
    with torch.no_grad():
        plain = task.net(clouds.points)
    return full_predictions(task, clouds, 7, tmp_path, CPU), plain


def test_full_predictions_are_those_of_the_net(tmp_path):
    found, plain = predictions(tmp_path)
    torch.testing.assert_close(found, plain)
    other, other_plain = predictions(tmp_path, seed=1)
    torch.testing.assert_close(other, other_plain)
    assert not torch.allclose(found, other)
    data = small_dataset()
    torch.testing.assert_close(*predictions(tmp_path, clouds=data.test))
    assert len(list(tmp_path.rglob("*.pt"))) == 3


def test_full_predictions_are_read_from_their_file(tmp_path):
    found, _ = predictions(tmp_path)
    (path,) = tmp_path.rglob("*.pt")
    torch.save(found + 1, path)
    torch.testing.assert_close(predictions(tmp_path)[0], found + 1)


def test_full_predictions_damaged_file_is_computed_again(tmp_path):
    found, _ = predictions(tmp_path)
    (path,) = tmp_path.rglob("*.pt")
    for content in (b"", path.read_bytes()[:100], b"x" * 500):
        path.write_bytes(content)
        torch.testing.assert_close(predictions(tmp_path)[0], found)
    torch.save(found[:-1], path)
    torch.testing.assert_close(predictions(tmp_path)[0], found)
    torch.save(found * float("nan"), path)
    path.with_name(f"{TEMPORARY}left by a kill.pt").touch()
    torch.testing.assert_close(predictions(tmp_path)[0], found)
    assert list(path.parent.iterdir()) == [path]
