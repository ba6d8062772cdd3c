import pytest
import torch

from mops_lightning.data.pairs import Pairs
from mops_lightning.errors import UserError
from mops_lightning.losses.registration import quaternion_loss
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.ops.points import gather_points
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks import refinement
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.tasks.refinement import Refinement
from mops_lightning.tasks.registration import Registration
from mops_lightning.types import Batch

TASKS = {
    "classification": lambda: Classification(PointNetVanilla(5), 5),
    "reconstruction": lambda: Reconstruction(AutoEncoder(50, 16, (8, 8), (16,))),
}


def disagreements(task, batch, rows):
    found = task.predict(batch, gather_points(batch.points, rows))
    return task.disagreement(found, task.predict(batch, batch.points))


@pytest.mark.parametrize("name", TASKS)
def test_refinement_brings_prediction_nearer(name, rng, monkeypatch):
    torch.manual_seed(0)
    task = TASKS[name]().double().eval()
    monkeypatch.setattr(refinement, "BATCH_POINTS", 100)  # two clouds at a time
    with torch.inference_mode():  # as in Lightning's tests
        batch = Batch(torch.randn(3, 50, 3, generator=rng).double(), torch.zeros(3).long())
        before = {m: FPSSampler(m)(batch.points).indices for m in (4, 9)}
        after = Refinement(task, 2)(batch, before)
        for m, rows in after.items():
            assert all(len(set(row)) == m for row in rows.tolist())
            was = disagreements(task, batch, before[m])
            assert was.max() > 0
            apart = disagreements(task, batch, rows)
            # Some farthest points already give the whole cloud's prediction.
            assert torch.where(was > 0, apart < was, apart == 0).all()


def test_refinement_of_unsuitable_task_or_net_raises():
    pairs = Registration(PCRNet(), Pairs(), quaternion_loss)
    with pytest.raises(UserError, match="refine must be 0 for registration, got 2"):
        Refinement(pairs, 2)

    class Mean(torch.nn.Module):
        def forward(self, points):
            return points.mean(1)

    with pytest.raises(UserError, match=r"refine must be 0 with Mean, got 2.*pointnet"):
        Refinement(Classification(Mean(), 3), 2)
