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
from tests.support.rigid import motion
from tests.support.training import quiet_trainer, small_dataset


class Kabsch(torch.nn.Module):
    """The exact answer where point i of the source is point i of the target."""

    def forward(self, source, target):
        source_mean = source.mean(1, keepdim=True)
        target_mean = target.mean(1, keepdim=True)
        covariance = (source - source_mean).mT @ (target - target_mean)
        u, _, vh = torch.linalg.svd(covariance)
        handedness = torch.linalg.det(vh.mT @ u.mT).sign()
        flip = torch.eye(3).repeat(len(u), 1, 1)
        flip[:, 2, 2] = handedness
        rotation = vh.mT @ flip @ u.mT
        shift = target_mean - source_mean @ rotation.mT
        scalar_last = Rotation.from_matrix(rotation.numpy()).as_quat()
        quaternion = torch.from_numpy(scalar_last).roll(1, 1)
        return Motion(quaternion.float(), shift[:, 0])


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
    assert_close(apart, torch.full_like(apart, 5.25))


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
    loader = CloudLoader(small_dataset(test=4).test, 4, make_batch=module.task.make_batch)
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
    # Samples have rings, full clouds have none.
    assert [len(cell.collections) for cell in axes] == [2, 4, 2, 2, 4, 2]
    titles = [cell.get_title() for cell in axes[:3]]
    assert titles == ["before (centred)", "by sampled", "by full"]
    result = module.step(batch, batch.points)
    _, error = RotationError.of(result.predictions, result.targets)
    assert text_of(axes[5]) == f"rotation error {error:.1f}°"
    still = identity_motion(batch.points[:2])
    _, angle = RotationError.of(result.targets, still)
    assert text_of(axes[3]) == f"tall, {angle:.1f}° apart"


def test_clouds_of_a_pair_have_titles_of_their_own():
    assert cloud_titles(task(), ["long"]) == ["long_source", "long_target"]
