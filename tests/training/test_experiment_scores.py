"""Which points every score is computed from, through Lightning's trainer and by their outcome."""

import math
from itertools import pairwise

import pytest
import torch

from mops_lightning import FPSSampler, GumbelSampler, RandomSampler, VoxelSampler
from mops_lightning.data.loader import CloudLoader
from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.samplers.local import LocalAnchors
from mops_lightning.samplers.samplenet import SampleNet
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.scores import Scores
from tests.support.plain import plain_farthest
from tests.support.recording import Fingerprint, RecordingTask, numbered_clouds
from tests.support.samplers import SAMPLERS
from tests.support.training import quiet_trainer

LEFT_OUT = ("serial", "mops-anchors", "fmops-anchors", "snet-without-norm")
"""Samplers whose points are read like those of others."""
BASELINES = {"fps": FPSSampler, "random": RandomSampler, "voxel": VoxelSampler}


@pytest.fixture(params=[name for name in SAMPLERS if name not in LEFT_OUT])
def sampler(request):
    """A sampler whose generated points are spread, but so little that some matches repeat."""
    torch.manual_seed(0)
    made = SAMPLERS[request.param](8)
    with torch.no_grad():
        for name, weight in made.named_parameters():
            if weight.ndim == 2:
                weight.mul_(4 if name.startswith("queries") else 1.5)
    return made.eval()


def experiment(sampler, m=8, **settings):
    baselines = {name: make(8) for name, make in BASELINES.items()}
    sizes = (5, 8) if sampler.flexible else (8,)
    task = RecordingTask(Fingerprint())
    return Experiment(task, sampler, "nothing", baselines=baselines, sizes=sizes, m=m, **settings)


@torch.no_grad()
def expected_points(sampler, cloud, m):
    """Every readout of one cloud ``(N, 3)``, by its definition."""
    sampled = sampler(cloud[None], m)
    if not sampler.generates:
        return {"sampled": cloud[sampled.indices[0]]}
    squares = (sampled.points[0][:, None] - cloud).square().sum(2)
    rows = squares.argmin(1).tolist()
    filled = plain_farthest(cloud, dict.fromkeys(rows), m)
    sets = {"generated": sampled.points[0], "matched": cloud[rows], "completed": cloud[filled]}
    if isinstance(sampler, SampleNet):
        sets["projected"] = torch.stack(
            [plain_projected(q, cloud, sampler) for q in sets["generated"]]
        )
    return sets


def plain_projected(query, cloud, sampler):
    """The mean of the k points nearest to a query, weighted by the learned temperature."""
    squares = (query - cloud).square().sum(1).tolist()
    nearest = sorted(range(len(cloud)), key=squares.__getitem__)[: sampler.k]
    scale = float(sampler.temperature) ** 2
    weights = [math.exp((squares[nearest[0]] - squares[row]) / scale) for row in nearest]
    total = sum(weights)
    return sum(weight / total * cloud[row] for weight, row in zip(weights, nearest, strict=True))


def expected_scores(module, clouds, sizes, baselines=BASELINES):
    """The mean fingerprint of every readout and baseline at every size."""
    sums: dict[str, list[float]] = {}
    for cloud in clouds:
        for m in sizes:
            prefix = f"m{m}/" if len(sizes) > 1 else ""
            sets = expected_points(module.sampler, cloud, m)
            sets |= {name: make(m)(cloud[None]).points[0] for name, make in baselines.items()}
            for name, points in sets.items():
                assert points.shape == (m, 3)
                score = float(module.task.net(points[None]))
                sums.setdefault(f"{prefix}{name}", []).append(score)
        if baselines:
            sums.setdefault("full", []).append(float(module.task.net(cloud[None])))
    return {name: sum(values) / len(clouds) for name, values in sums.items()}


def scores(trainer):
    """The logged fingerprints, by readout."""
    return {
        name.removesuffix("/fingerprint"): float(value)
        for name, value in trainer.callback_metrics.items()
        if name.endswith("/fingerprint")
    }


def assert_distinct(values):
    """Assert that no two scores are so near that a test could take one for the other."""
    values = sorted(values)
    assert all(after - before > 1e-3 for before, after in pairwise(values)), values


def test_test_scores_each_readout_from_its_own_points(sampler, calls):
    data = numbered_clouds()
    module, trainer = experiment(sampler), quiet_trainer(1)
    results = trainer.test(module, CloudLoader(data.test, 4), verbose=False)
    assert results == [{name: float(value) for name, value in trainer.callback_metrics.items()}]
    got = scores(trainer)
    want = expected_scores(module, data.test.points, module.sizes)
    want = {f"test/{name}": value for name, value in want.items()}
    # A sampler and the baseline of its kind return the same points; voxels share no match; what
    # Gumbel subset sampling generates in the test are input points.
    same: dict[type, tuple[str, ...]] = {FPSSampler: ("fps",), RandomSampler: ("random",)}
    same |= {VoxelSampler: ("voxel", "completed"), GumbelSampler: ("matched",)}
    twins = same.get(type(sampler), ())
    if isinstance(getattr(sampler, "queries", None), LocalAnchors):
        twins = ("matched", "completed")  # columns of three entries stay next to their anchors
    assert_distinct(v for name, v in want.items() if name.rsplit("/")[-1] not in twins)
    assert got == pytest.approx(want, abs=1e-4)
    for m in module.sizes if sampler.generates else ():
        sets = [expected_points(sampler, cloud, m)["matched"] for cloud in data.test.points]
        counted = sum(len(rows.unique(dim=0)) for rows in sets) / len(sets)
        size = f"m{m}/" if sampler.flexible else ""
        found = trainer.callback_metrics[f"test/{size}matched/unique_points"]
        assert found == pytest.approx(counted)
    main = "generated" if sampler.generates else "sampled"
    own_size = "m8/" if sampler.flexible else ""
    assert module.score_name == f"test/{own_size}{main}/fingerprint"
    for call in calls:
        assert torch.equal(call.clouds, data.test.points[torch.tensor(call.labels) - 1000])
    assert not any(call.training for call in calls)


@pytest.mark.parametrize("sampler", ["mops", "samplenet-progressive", "fps"], indirect=True)
def test_validation_scores_readouts_at_own_size(sampler):
    data, m = numbered_clouds(), 5 if sampler.flexible else 8
    module, trainer = experiment(sampler, m), quiet_trainer(1)
    trainer.validate(module, CloudLoader(data.train, 3), verbose=False)
    want = expected_scores(module, data.train.points, (m,), baselines={})
    assert_distinct(want.values())
    want = {f"val/{name}": value for name, value in want.items()}
    assert scores(trainer) == pytest.approx(want, abs=1e-4)


@pytest.mark.parametrize("sampler", ["fmops", "fps"], indirect=True)
def test_loss_of_each_size_is_that_of_main_readout(sampler):
    data = numbered_clouds()
    module, trainer = experiment(sampler), quiet_trainer(1)
    trainer.test(module, CloudLoader(data.test, 4), verbose=False)
    want = {}
    for m in (5, 8):
        main = "generated" if sampler.generates else "sampled"
        points = [expected_points(sampler, cloud, m)[main] for cloud in data.test.points]
        loss = module.task.net(torch.stack(points)).square().mean()
        want[f"test/m{m}/loss/task"] = float(loss)
    assert_distinct(want.values())
    got = {name: float(v) for name, v in trainer.callback_metrics.items() if "/loss/" in name}
    assert got == pytest.approx(want, rel=1e-4)


def test_scores_loss_of_nan_is_nan():
    made = Scores(lambda: collection(Accuracy(3)), ("generated",), ())
    assert made.update_loss("test/loss/x", torch.tensor(torch.nan), 2).compute().isnan()
