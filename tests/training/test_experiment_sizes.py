from itertools import pairwise

import pytest
import torch

from mops_lightning.data.loader import CloudLoader
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.samplers.fps import FPSSampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.poisson import PoissonSampler
from mops_lightning.samplers.snet import ProgressiveSNet
from mops_lightning.samplers.voxel import VoxelSampler
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.build import sizes_to_test
from tests.support.recording import Fingerprint, RecordingTask
from tests.support.training import quiet_trainer, small_dataset

SEVEN = (1, 2, 3, 5, 8, 13, 20)


def trained(sampler):
    """A sampler after some steps, whose running statistics have changed."""
    data = small_dataset()
    torch.manual_seed(0)
    module = Experiment(
        RecordingTask(Fingerprint()),
        sampler,
        make_optimizer=lambda parameters: torch.optim.Adam(parameters, lr=1e-2),
    )
    loader = CloudLoader(data.test, 6)
    quiet_trainer(2).fit(module, CloudLoader(data.train, 6, shuffle=True, drop_last=True), loader)
    return module


def metrics_of(module, sizes, m=None, baselines=None):
    fresh = Experiment(
        module.task, module.sampler, "nothing", sizes=sizes, m=m, baselines=baselines
    )
    trainer = quiet_trainer(1)
    trainer.test(fresh, CloudLoader(small_dataset().test, 4), verbose=False)
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def fmops():
    torch.manual_seed(0)
    return FMOPSNet(20, feature_channels=(8, 8), rho_channels=(16, 8))


def progressive():
    torch.manual_seed(0)
    return ProgressiveSNet(20, feature_channels=(8, 8), head_channels=(16,))


@pytest.mark.parametrize("make", [fmops, progressive])
def test_test_several_sizes_equals_single_tests(make):
    module = trained(make())

    def baselines():
        return {"fps": FPSSampler(20), "voxel": VoxelSampler(20), "poisson": PoissonSampler(20)}

    together = metrics_of(module, SEVEN, baselines=baselines())
    readouts = {"generated", "matched", "completed", "fps", "voxel", "poisson"}
    for m in SEVEN:
        alone = metrics_of(module, (m,), m, baselines())
        scored = {name.split("/")[1] for name in alone if name.endswith("/fingerprint")}
        assert scored == {*readouts, "full"}
        for name, value in alone.items():
            within = name if "/full/" in name else name.replace("test/", f"test/m{m}/")
            assert together[within] == pytest.approx(value, abs=1e-5), within
    for readout in readouts:
        scores = [together[f"test/m{m}/{readout}/fingerprint"] for m in SEVEN]
        assert min(b - a for a, b in pairwise(sorted(scores))) > 1e-4, readout


def test_score_name_several_sizes_uses_own_size():
    module = Experiment(Classification(PointNetVanilla(3), 3), fmops(), sizes=(5, 8), m=8)
    assert module.score_name == "test/m8/generated/accuracy"
    assert Experiment(module.task, fmops(), m=8).score_name == "test/generated/accuracy"


@pytest.mark.parametrize(
    ("sizes", "m", "sampler", "expected"),
    [
        ("auto", 32, FMOPSNet(512), (8, 16, 32, 64, 128, 256, 512)),
        ("auto", 20, FMOPSNet(100), (8, 16, 20, 32, 64)),
        ("auto", 32, MOPSNet(32), (32,)),
        ("auto", 32, FPSSampler(32), (32,)),
        ([64, 8], 32, FPSSampler(32), (8, 32, 64)),
        ([64, 8, 8], 8, FMOPSNet(100), (8, 64)),
        ([32], 32, MOPSNet(32), (32,)),
        ("auto", 32, None, ()),
    ],
)
def test_sizes_to_test_returns_ascending_sizes(sizes, m, sampler, expected):
    assert sizes_to_test(sizes, m, sampler, 1024) == expected


@pytest.mark.parametrize(
    ("sizes", "m", "sampler", "named"),
    [
        ([8], 32, MOPSNet(32), r"returns 32 points.*got sizes=\[8\]"),
        ([101], 32, FMOPSNet(100), "sizes must be at most sampler.m_max=100, got 101"),
        ([201], 32, FPSSampler(32), "sizes must be at most the 200 points of a cloud, got 201"),
        ("auto", 101, FMOPSNet(100), "m must be at most sampler.m_max=100, got 101"),
        ("auto", 32, FMOPSNet(512), "sampler.m_max must be at most the 200 points .* got 512"),
    ],
)
def test_sizes_to_test_out_of_range_raises(sizes, m, sampler, named):
    with pytest.raises(UserError, match=named):
        sizes_to_test(sizes, m, sampler, 200)
