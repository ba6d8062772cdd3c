"""Which points every score is computed from, through Lightning's trainer and by their outcome."""

import math
from collections import defaultdict
from itertools import pairwise
from statistics import mean

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
    sampler = SAMPLERS[request.param](8)
    with torch.no_grad():
        for name, weight in sampler.named_parameters():
            factor = 4 if name.startswith("queries") else 1.5
            if weight.ndim == 2:
                weight.mul_(factor)
    return sampler.eval()


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
    generated = sampled.points[0]
    squares = (generated[:, None] - cloud).square().sum(2)
    rows = squares.argmin(1).tolist()
    filled = plain_farthest(cloud, dict.fromkeys(rows), m)
    sets = {
        "generated": generated,
        "matched": cloud[rows],
        "completed": cloud[filled],
    }
    if isinstance(sampler, SampleNet):
        projected = [plain_projected(query, cloud, sampler) for query in generated]
        sets["projected"] = torch.stack(projected)
    return sets


def plain_projected(query, cloud, sampler):
    """The mean of the k points nearest to a query, weighted by the learned temperature."""
    squares = (query - cloud).square().sum(1).tolist()
    rows = sorted(range(len(cloud)), key=squares.__getitem__)
    nearest = rows[: sampler.k]
    scale = float(sampler.temperature) ** 2
    weights = {}
    for row in nearest:
        farther = squares[row] - squares[nearest[0]]
        weights[row] = math.exp(-farther / scale)
    total = sum(weights.values())
    return sum(weight / total * cloud[row] for row, weight in weights.items())


def expected_scores(module, clouds, sizes, baselines=BASELINES):
    """The mean fingerprint of every readout and baseline at every size."""
    prints: dict[str, list[float]] = defaultdict(list)
    for cloud in clouds:
        for m in sizes:
            prefix = f"m{m}/" if len(sizes) > 1 else ""
            sets = expected_points(module.sampler, cloud, m)
            for name, make in baselines.items():
                sets[name] = make(m)(cloud[None]).points[0]
            for name, points in sets.items():
                assert points.shape == (m, 3)
                prints[f"{prefix}{name}"].append(fingerprint(module, points))
        if baselines:
            prints["full"].append(fingerprint(module, cloud))
    return {name: mean(values) for name, values in prints.items()}


def fingerprint(module, points):
    return float(module.task.net(points[None]))


def scores(trainer):
    """The logged fingerprints, by readout."""
    found = {}
    for name, value in trainer.callback_metrics.items():
        readout, _, metric = name.rpartition("/")
        if metric == "fingerprint":
            found[readout] = float(value)
    return found


def assert_distinct(values):
    """Assert that no two scores are so near that a test could take one for the other."""
    in_order = sorted(values)
    for before, after in pairwise(in_order):
        assert after - before > 1e-3, in_order


def test_test_scores_each_readout_from_its_own_points(sampler, calls):
    data = numbered_clouds()
    module = experiment(sampler)
    trainer = quiet_trainer(1)

    results = trainer.test(module, CloudLoader(data.test, 4), verbose=False)

    assert results == [{name: float(value) for name, value in trainer.callback_metrics.items()}]
    expected = expected_scores(module, data.test.points, module.sizes)
    twins = twins_of(sampler)
    assert_distinct(v for name, v in expected.items() if name.rsplit("/")[-1] not in twins)
    assert scores(trainer) == pytest.approx(with_prefix("test/", expected), abs=1e-4)
    if sampler.generates:
        assert_distinct_points(trainer, sampler, data.test.points, module.sizes)
    main = "generated" if sampler.generates else "sampled"
    own_size = "m8/" if sampler.flexible else ""
    assert module.score_name == f"test/{own_size}{main}/fingerprint"
    for call in calls:
        rows = torch.tensor(call.labels) - 1000
        assert torch.equal(call.clouds, data.test.points[rows])
    assert not any(call.training for call in calls)


def twins_of(sampler):
    """The readouts and baselines whose points may equal those of another."""
    if isinstance(getattr(sampler, "queries", None), LocalAnchors):
        return ("matched", "completed")  # columns of three entries stay next to their anchors
    if getattr(sampler, "is_framed", False):
        return ("matched", "completed")  # of these clouds, columns choose their anchors
    twins: dict[type, tuple[str, ...]] = {
        FPSSampler: ("fps",),
        RandomSampler: ("random",),
        VoxelSampler: ("voxel", "completed"),  # voxels share no match
        GumbelSampler: ("matched",),  # it generates input points in the test
    }
    return twins.get(type(sampler), ())


def with_prefix(prefix, values):
    return {f"{prefix}{name}": value for name, value in values.items()}


def assert_distinct_points(trainer, sampler, clouds, sizes):
    """Assert that the distinct matched points are counted at every size."""
    for m in sizes:
        counts = []
        for cloud in clouds:
            matched = expected_points(sampler, cloud, m)["matched"]
            counts.append(len(matched.unique(dim=0)))
        size = f"m{m}/" if sampler.flexible else ""
        counted = trainer.callback_metrics[f"test/{size}matched/unique_points"]
        assert counted == pytest.approx(mean(counts))


@pytest.mark.parametrize("sampler", ["mops", "samplenet-progressive", "fps"], indirect=True)
def test_validation_scores_readouts_at_own_size(sampler):
    clouds = numbered_clouds().train
    m = 5 if sampler.flexible else 8
    module = experiment(sampler, m)
    trainer = quiet_trainer(1)

    trainer.validate(module, CloudLoader(clouds, 3), verbose=False)

    expected = expected_scores(module, clouds.points, (m,), baselines={})
    assert_distinct(expected.values())
    assert scores(trainer) == pytest.approx(with_prefix("val/", expected), abs=1e-4)


@pytest.mark.parametrize("sampler", ["fmops"], indirect=True)
def test_score_is_that_of_own_size_among_several(sampler):
    assert experiment(sampler, m=5).score_name == "test/m5/generated/fingerprint"
    assert experiment(sampler, m=8).score_name == "test/m8/generated/fingerprint"


@pytest.mark.parametrize("sampler", ["fmops", "fps"], indirect=True)
def test_loss_of_each_size_is_that_of_main_readout(sampler):
    clouds = numbered_clouds().test
    module = experiment(sampler)
    trainer = quiet_trainer(1)

    trainer.test(module, CloudLoader(clouds, 4), verbose=False)

    main = "generated" if sampler.generates else "sampled"
    expected = {}
    for m in (5, 8):
        points = [expected_points(sampler, cloud, m)[main] for cloud in clouds.points]
        loss = module.task.net(torch.stack(points)).square().mean()
        expected[f"test/m{m}/loss/task"] = float(loss)
    losses = {}
    for name, value in trainer.callback_metrics.items():
        if "/loss/" in name:
            losses[name] = float(value)
    assert_distinct(expected.values())
    assert losses == pytest.approx(expected, rel=1e-4)


def test_scores_loss_of_nan_is_nan():
    made = Scores(lambda: collection(Accuracy(3)), ("generated",), ())
    assert made.update_loss("test/loss/x", torch.tensor(torch.nan), 2).compute().isnan()
