import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from mops_lightning import FPSSampler
from mops_lightning.data.loader import CloudLoader
from mops_lightning.metrics.registration import RotationError
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.ops.rigid import Motion, identity_motion
from mops_lightning.tasks.base import figures_of
from mops_lightning.tasks.registration import Registration, pair_batch
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.pictures import cloud_titles
from tests.support.figures import drawn_places
from tests.support.rigid import motion
from tests.support.training import quiet_trainer, small_dataset


class Kabsch(torch.nn.Module):
    """The exact answer where point i of the source is point i of the target."""

    def forward(self, source, target):
        quaternions = []
        shifts = []
        for source_cloud, target_cloud in zip(source.numpy(), target.numpy(), strict=True):
            source_mean = source_cloud.mean(0)
            target_mean = target_cloud.mean(0)
            centred_source = source_cloud - source_mean
            centred_target = target_cloud - target_mean
            rotation, _ = Rotation.align_vectors(centred_target, centred_source)
            quaternions.append(rotation.as_quat(scalar_first=True))
            shifts.append(target_mean - rotation.apply(source_mean))
        quaternion = torch.tensor(np.array(quaternions)).float()
        shift = torch.tensor(np.array(shifts)).float()
        return Motion(quaternion, shift)


def small_net():
    torch.manual_seed(0)
    return PCRNet(feature_channels=(16, 32))


def task(net=None, **settings):
    return Registration(net or small_net(), **settings)


def test_step_exact_net_recovers_motions(randn):
    source = randn(5, 40, 3) + 3  # far from its centroid
    true = motion(1)
    batch = pair_batch(source, true.apply(source), true)

    result = task(Kabsch()).step(batch, batch.points)

    found = result.predictions
    assert torch.equal(result.targets.translation, true.translation)
    assert RotationError.of(found, true).max() < 1e-2
    assert_close(found.translation, true.translation, atol=1e-4, rtol=0)
    assert sum(result.losses.values()) < 1e-3


def test_disagreement_of_shifted_motions_is_squared_shift():
    true = motion(1)
    shift = torch.tensor([1.0, -2.0, 0.5])
    moved = true._replace(translation=true.translation + shift)

    apart = task().disagreement(moved, true)

    expected = 1 + 2**2 + 0.5**2
    assert_close(apart, torch.full_like(apart, expected))


def test_disagreement_of_turned_motions_is_that_of_the_turned_axes():
    still = Motion(torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3))
    half = 0.5**0.5
    quarter_turn = Motion(torch.tensor([[half, half, 0, 0]]), torch.zeros(1, 3))

    apart = task().disagreement(quarter_turn, still)

    # Two unit axes end a square root of 2 away.
    assert apart.tolist() == pytest.approx([4.0])


class RecordingSampler(FPSSampler):
    def __init__(self, m):
        super().__init__(m)
        self.shapes = []

    def sample(self, points, m):
        self.shapes.append(tuple(points.shape))
        return super().sample(points, m)


def test_test_samples_sources_and_targets_in_one_call():
    sampler = RecordingSampler(8)
    module = Experiment(task(resample=40), sampler, sizes=(4, 8))
    clouds = small_dataset(test=4).test
    loader = CloudLoader(clouds, 4, make_batch=module.task.make_batch)

    quiet_trainer(1).test(module, loader, verbose=False)

    assert sampler.shapes == [(8, 40, 3)]


def text_of(axes):
    return axes.texts[0].get_text()


def test_figures_show_every_readout_and_its_error(rng):
    module = task()
    loader = CloudLoader(small_dataset().test, 4, make_batch=module.make_batch)
    batch = loader.batch_of(torch.tensor([0, 1]))
    sample = FPSSampler(8)(batch.points).points
    samples = {"sampled": sample, "full": batch.points}

    figures = figures_of(module, batch, samples, ["long", "tall"])

    axes = figures["pairs"].axes
    result = module.step(batch, batch.points)
    still = identity_motion(batch.points[:2])
    _, error = RotationError.of(result.predictions, result.targets)
    _, angle = RotationError.of(result.targets, still)
    # Samples have rings, full clouds have none.
    numbers_of_sets = [len(cell.collections) for cell in axes]
    titles = [cell.get_title() for cell in axes[:3]]
    assert numbers_of_sets == [2, 4, 2, 2, 4, 2]
    assert titles == ["before (centred)", "by sampled", "by full"]
    assert text_of(axes[3]) == f"tall, {angle:.1f}° apart"
    assert text_of(axes[5]) == f"rotation error {error:.1f}°"


def test_figures_draw_sources_on_their_targets_after_the_true_motion(randn):
    module = task(Kabsch())
    source = randn(2, 30, 3) + 3  # far from its centroid
    true = motion(1, number=2)
    batch = pair_batch(source, true.apply(source), true)
    sample = batch.points[:, :6]

    figures = figures_of(module, batch, {"sampled": sample}, ["long", "tall"])

    for axes in (figures["pairs"].axes[1], figures["pairs"].axes[3]):
        moved, target, moved_sample, sample_of_target = map(drawn_places, axes.collections)
        assert moved == pytest.approx(target, abs=1e-4)
        assert moved_sample == pytest.approx(sample_of_target, abs=1e-4)


def test_clouds_of_a_pair_have_titles_of_their_own():
    assert cloud_titles(task(), ["long"]) == ["long_source", "long_target"]
