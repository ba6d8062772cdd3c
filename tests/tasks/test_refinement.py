from typing import Any

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.ops.points import gather_points
from mops_lightning.ops.rigid import Motion
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.tasks import refinement
from mops_lightning.tasks.base import Task
from mops_lightning.tasks.classification import Classification
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.tasks.refinement import Refinement, improve
from mops_lightning.tasks.registration import Registration
from mops_lightning.types import Batch, PairBatch

TASKS = {
    "classification": lambda: Classification(PointNetVanilla(5), 5),
    "reconstruction": lambda: Reconstruction(AutoEncoder(50, 16, (8, 8))),
    "registration": lambda: Registration(PCRNet(feature_channels=(16, 32))),
}


def batch_of(name, points):
    if name == "registration":
        nothing = torch.zeros(0)
        return PairBatch(points, nothing, torch.zeros(len(points) // 2, 4), nothing)
    return Batch(points, torch.zeros(len(points)).long())


def disagreements(task, batch, rows):
    found = task.predict(batch, gather_points(batch.points, rows))
    return task.disagreement(found, task.predict(batch, batch.points))


@pytest.mark.parametrize("name", TASKS)
def test_refinement_brings_prediction_nearer(name, rng, monkeypatch):
    task = TASKS[name]().double().eval()
    monkeypatch.setattr(refinement, "BATCH_POINTS", 100)  # two clouds at a time
    with torch.inference_mode():  # as in Lightning's tests
        batch = batch_of(name, torch.randn(6, 50, 3, generator=rng).double())
        before = {m: FPSSampler(m)(batch.points).indices for m in (4, 9)}
        after = Refinement(task, 2)(batch, before)
        for m, rows in after.items():
            assert all(len(set(row)) == m for row in rows.tolist())
            was = disagreements(task, batch, before[m])
            assert was.max() > 0
            apart = disagreements(task, batch, rows)
            # Some farthest points already give the whole cloud's prediction.
            assert torch.where(was > 0, apart < was, apart == 0).all()


def test_refinement_of_pairs_refines_sources_for_whole_targets_then_targets_for_them(rng):
    task: Any = TASKS["registration"]().double().eval()
    batch = batch_of("registration", torch.randn(6, 50, 3, generator=rng).double())
    rows = FPSSampler(5)(batch.points).indices
    refined = Refinement(task, 3)(batch, {5: rows})[5]
    source, target = (task.net.point_features(points) for points in batch.points.chunk(2))
    whole = task.predict(batch, batch.points)

    def refined_for(features, start, of_pair):
        def apart(candidates, cloud):
            found = refinement.predict_pooled(task, batch, torch.cat(of_pair(candidates, cloud)))
            return task.disagreement(found, Motion(*(part[cloud] for part in whole)))

        return improve(features, start, apart, 3)

    def targets_for(pooled):
        return refined_for(target, rows[3:], lambda found, cloud: [pooled[cloud], found])

    with torch.no_grad():
        sources = refined_for(source, rows[:3], lambda found, cloud: [found, target.amax(1)[cloud]])
        assert torch.equal(refined[:3], sources)
        assert torch.equal(refined[3:], targets_for(gather_points(source, sources).amax(1)))
        assert not torch.equal(refined[3:], targets_for(source.amax(1)))


def test_refinement_of_unsuitable_task_or_net_raises():
    pairs = Registration(PCRNet(iterations=2))
    with pytest.raises(UserError, match=r"refine must be 0 with this PCRNet, got 2.*iterations=1"):
        Refinement(pairs, 2)

    class Mean(torch.nn.Module):
        def forward(self, points):
            return points.mean(1)

    with pytest.raises(UserError, match=r"refine must be 0 for task, got 1"):
        Refinement(Task(Mean()), 1)

    with pytest.raises(UserError, match=r"refine must be 0 with this Mean, got 2.*pointnet"):
        Refinement(Classification(Mean(), 3), 2)
