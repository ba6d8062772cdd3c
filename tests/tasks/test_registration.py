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
            shift = target_mean - rotation.apply(source_mean)
            quaternions.append(rotation.as_quat(scalar_first=True))
            shifts.append(shift)
        quaternion = torch.tensor(np.array(quaternions))
        translation = torch.tensor(np.array(shifts))
        return Motion(quaternion.float(), translation.float())


def small_net():
    torch.manual_seed(0)
    return PCRNet(feature_channels=(16, 32))


def task(net=None, **settings):
    if net is None:
        net = small_net()
    return Registration(net, **settings)


def test_step_exact_net_recovers_motions(randn):
    module = task(Kabsch())
    source = randn(5, 40, 3) + 3  # far from its centroid
    true = motion(1)
    target = true.apply(source)
    batch = pair_batch(source, target, true)

    result = module.step(batch, batch.points)

    found = result.predictions
    degrees = RotationError.of(found, true)
    loss = sum(result.losses.values())
    assert torch.equal(result.targets.translation, true.translation)
    assert degrees.max() < 1e-2
    assert_close(found.translation, true.translation, atol=1e-4, rtol=0)
    assert loss < 1e-3


def test_disagreement_of_shifted_motions_is_squared_shift():
    module = task()
    true = motion(1)
    shift = torch.tensor([1.0, -2.0, 0.5])
    shifted = true.translation + shift
    moved = true._replace(translation=shifted)

    apart = module.disagreement(moved, true)

    squared_shift = 1 + 2**2 + 0.5**2
    expected = torch.full_like(apart, squared_shift)
    assert_close(apart, expected)


def test_disagreement_of_turned_motions_is_that_of_the_turned_axes():
    module = task()
    half = 0.5**0.5
    no_shift = torch.zeros(1, 3)
    no_turn = torch.tensor([[1.0, 0, 0, 0]])
    quarter_turn = torch.tensor([[half, half, 0, 0]])
    still = Motion(no_turn, no_shift)
    turned = Motion(quarter_turn, no_shift)

    apart = module.disagreement(turned, still)

    # Two unit axes end a square root of 2 away.
    assert apart.tolist() == pytest.approx([4.0])


class RecordingSampler(FPSSampler):
    def __init__(self, m):
        super().__init__(m)
        self.shapes = []

    def sample(self, points, m):
        shape = tuple(points.shape)
        self.shapes.append(shape)
        return super().sample(points, m)


def test_test_samples_sources_and_targets_in_one_call():
    sampler = RecordingSampler(8)
    registration = task(resample=40)
    module = Experiment(registration, sampler, sizes=(4, 8))
    clouds = small_dataset(test=4).test
    loader = CloudLoader(clouds, 4, make_batch=registration.make_batch)
    trainer = quiet_trainer(1)

    trainer.test(module, loader, verbose=False)

    four_sources_and_four_targets = (8, 40, 3)
    assert sampler.shapes == [four_sources_and_four_targets]


def text_of(axes):
    first_text = axes.texts[0]
    return first_text.get_text()


def numbers_of_sets(row):
    """Return how many sets of points each picture of a row draws."""
    return [len(axes.collections) for axes in row]


def test_figures_show_every_readout_and_its_error(rng):
    module = task()
    clouds = small_dataset().test
    loader = CloudLoader(clouds, 4, make_batch=module.make_batch)
    first_two = torch.tensor([0, 1])
    batch = loader.batch_of(first_two)
    fps = FPSSampler(8)
    sample = fps(batch.points).points
    samples = {"sampled": sample, "full": batch.points}

    figures = figures_of(module, batch, samples, ["long", "tall"])

    first_row = figures["pairs"].axes[:3]
    second_row = figures["pairs"].axes[3:]
    # Samples have rings, full clouds have none.
    assert numbers_of_sets(first_row) == [2, 4, 2]
    assert numbers_of_sets(second_row) == [2, 4, 2]
    titles = [axes.get_title() for axes in first_row]
    assert titles == ["before (centred)", "by sampled", "by full"]
    before, _, by_full = second_row
    result = module.step(batch, batch.points)
    sources, _ = batch.points.chunk(2)
    still = identity_motion(sources)
    _, angle = RotationError.of(result.targets, still)
    _, error = RotationError.of(result.predictions, result.targets)
    assert text_of(before) == f"tall, {angle:.1f}° apart"
    assert text_of(by_full) == f"rotation error {error:.1f}°"


def test_figures_draw_sources_on_their_targets_after_the_true_motion(randn):
    module = task(Kabsch())
    source = randn(2, 30, 3) + 3  # far from its centroid
    true = motion(1, number=2)
    target = true.apply(source)
    batch = pair_batch(source, target, true)
    sample = batch.points[:, :6]

    figures = figures_of(module, batch, {"sampled": sample}, ["long", "tall"])

    _, first_after, _, second_after = figures["pairs"].axes
    for axes in (first_after, second_after):
        places = [drawn_places(collection) for collection in axes.collections]
        drawn_source, drawn_target, sample_of_source, sample_of_target = places
        assert drawn_source == pytest.approx(drawn_target, abs=1e-4)
        assert sample_of_source == pytest.approx(sample_of_target, abs=1e-4)


def test_clouds_of_a_pair_have_titles_of_their_own():
    module = task()

    titles = cloud_titles(module, ["long"])

    assert titles == ["long_source", "long_target"]
