from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import FPSSampler, MOPSNet, earth_movers_distance
from mops_lightning.errors import UserError
from mops_lightning.nets.autoencoder import AutoEncoder
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.ops.nearest import chamfer_distance
from mops_lightning.tasks.base import figures_of
from mops_lightning.tasks.reconstruction import Reconstruction
from mops_lightning.training.experiment import Experiment
from mops_lightning.types import Batch


def task(**extra):
    torch.manual_seed(0)
    return Reconstruction(AutoEncoder(48, 8, (8, 8)), **extra)


def batch(rng, number=4, points=48):
    return Batch(torch.randn(number, points, 3, generator=rng), torch.zeros(number))


def test_step_loss_is_chamfer_plus_emd(rng):
    given = batch(rng, points=32)  # a single block
    sample = given.points[:, :8]
    module = Reconstruction(AutoEncoder(32, 8, (8, 8))).eval()

    losses = module.step(given, sample).losses

    built = module.net(sample)
    chamfer = chamfer_distance(built, given.points).mean()
    emd = earth_movers_distance(built, given.points).mean()
    assert set(losses) == {"chamfer", "emd"}
    assert_close(losses["chamfer"], chamfer)
    assert_close(losses["emd"], emd)


def test_step_assigns_points_by_blocks_of_32_in_one_round(rng):
    module = Reconstruction(AutoEncoder(100, 8, (8, 8))).eval()
    given = batch(rng, points=100)

    losses = module.step(given, given.points).losses

    built = module.net(given.points)
    expected = earth_movers_distance(built, given.points, block=32, rounds=1)
    assert_close(losses["emd"], expected.mean())


def test_disagreement_of_reconstructions_is_their_chamfer_distance(randn):
    found = randn(3, 20, 3)
    reference = randn(3, 20, 3)

    apart = task().disagreement(found, reference)

    assert_close(apart, chamfer_distance(found, reference))


def test_training_metrics_need_no_reference():
    assert set(task().metrics(training=True)) == {"chamfer", "emd"}
    assert {"chamfer", "emd", "nre_emd"} < set(task().metrics())


def scored(module, given, points):
    return module.scores(given, {"": points})[""]


def test_scores_of_large_clouds_have_a_finer_assignment_than_training(rng):
    module = Reconstruction(AutoEncoder(300, 8, (8, 8)), exact_up_to=299).eval()
    given = batch(rng, points=300)

    trained = module.step(given, given.points).predictions.emd
    found = scored(module, given, given.points).predictions.emd

    built = module.net(given.points)
    expected = earth_movers_distance(built, given.points, block=128, rounds=8)
    assert_close(found, expected)
    assert (found < trained).all()
    assert (earth_movers_distance(built, given.points) <= found).all()


def values_of(module, result):
    metrics = module.metrics()
    metrics.update(result.predictions, result.targets)
    return metrics.compute()


@pytest.mark.parametrize(
    ("exact_up_to", "expected"),
    [
        (None, {"nre_cd": 1, "nre_cd_of_means": 1}),
        (2048, {"nre_cd": 1, "nre_cd_of_means": 1, "nre_emd": 1, "nre_emd_of_means": 1}),
    ],
    ids=["chamfer", "chamfer-emd"],
)
def test_normalized_errors_full_cloud_are_one(exact_up_to, expected, rng):
    module = task(exact_up_to=exact_up_to).eval()
    given = batch(rng)

    values = values_of(module, scored(module, given, given.points))

    ratios = {}
    for name, value in values.items():
        if name.startswith("nre"):
            ratios[name] = value
    assert ratios == expected
    losses = module.step(given, given.points).losses
    assert len(losses) == len(expected) / 2


def test_normalized_errors_sample_match_plain_formula(rng):
    module = task().eval()
    given = batch(rng)
    sample = FPSSampler(4)(given.points).points

    values = values_of(module, scored(module, given, sample))

    built = module.net(sample)
    built_from_all = module.net(given.points)
    chamfer = chamfer_distance(built, given.points)
    chamfer_of_all = chamfer_distance(built_from_all, given.points)
    ratios = chamfer / chamfer_of_all
    emd = earth_movers_distance(built, given.points)
    assert_close(values["nre_cd"], ratios.mean())
    assert_close(values["chamfer"], chamfer.mean())
    assert_close(values["emd"], emd.mean())


def test_scores_are_exact_up_to_a_number_of_points(rng):
    given = batch(rng, number=1, points=300)
    net: Any = AutoEncoder(300, 8, (8, 8)).eval()
    torch.nn.init.normal_(net.decoder[-1].bias, generator=rng)  # points apart from each other
    up_to_300 = Reconstruction(net, exact_up_to=300)
    up_to_299 = Reconstruction(net, exact_up_to=299)

    exact = scored(up_to_300, given, given.points).predictions.emd
    approximate = scored(up_to_299, given, given.points).predictions.emd

    expected = earth_movers_distance(net(given.points), given.points)
    assert_close(exact, expected)
    assert approximate > exact + 1e-5


def test_scores_of_several_samples_equal_each_alone(rng):
    module = task().eval()
    given = batch(rng)
    four = FPSSampler(4)(given.points).points
    nine = FPSSampler(9)(given.points).points

    together = module.scores(given, {"four": four, "nine": nine})

    assert_same_scores(together["four"], scored(module, given, four))
    assert_same_scores(together["nine"], scored(module, given, nine))


def assert_same_scores(found, expected):
    assert found.losses == expected.losses
    for name in ("predictions", "targets"):
        distances = getattr(found, name)
        expected_distances = getattr(expected, name)
        assert torch.equal(distances.chamfer, expected_distances.chamfer)
        assert torch.equal(distances.emd, expected_distances.emd)


def test_score_name_is_that_of_generated_points_or_of_full_clouds():
    sampler = MOPSNet(8, feature_channels=(8, 8), rho_channels=(16, 8))

    of_sampler = Experiment(task(), sampler)
    of_task = Experiment(task(), learn="task")

    assert of_sampler.score_name == "test/generated/nre_cd"
    assert of_task.score_name == "test/full/chamfer"


def test_scored_other_cloud_size_needs_flexible_net(rng):
    module = Reconstruction(MFoldingNet(48, 2, 8, fold_channels=(8, 8))).eval()
    given = batch(rng, points=60)

    result = scored(module, given, given.points)

    assert result.predictions.emd.shape == (4,)
    with pytest.raises(UserError, match=r"48.*60"):
        scored(task(), given, given.points)


def test_figures_show_samples_and_reconstructions(rng):
    module = task().eval()
    given = batch(rng, number=2)
    chosen = FPSSampler(8)(given.points).points
    samples = {"sampled": chosen, "full": given.points}

    figures = figures_of(module, given, samples, ["long", "tall"])

    axes = figures["reconstructions"].axes
    assert len(axes) == 8
    titles = [column.get_title() for column in axes[:4]]
    assert titles == ["input", "from all points", "sampled", "from sampled"]
    (name,) = axes[4].texts
    assert name.get_text() == "tall"
    result = scored(module, given, chosen)
    _, ratio = result.predictions.chamfer / result.targets.chamfer
    (error,) = axes[7].texts
    assert error.get_text() == f"NRE {ratio:.2f}"
