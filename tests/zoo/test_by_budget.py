"""Files with the best sampler for each number of points, as ``compare --save`` writes them."""

import pytest
import torch

from mops_lightning import FMOPSNet, FPSSampler, PoissonSampler, load
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.samplers.by_budget import MOST, ByBudget
from mops_lightning.zoo import weights

BEST = "mops_lightning.samplers.by_budget.ByBudget"
FPS = {"_target_": "mops_lightning.samplers.fps.FPSSampler", "m": MOST, "start": "farthest"}
POISSON = {"_target_": "mops_lightning.samplers.poisson.PoissonSampler", "m": MOST, "seed": 3}
FMOPS = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 16}


def written(folder, sampler, nodes, channels=PointChannels()):  # noqa: B008  immutable
    node = {
        "_target_": BEST,
        "budgets": list(sampler.budgets),
        "best": list(sampler.best),
        "samplers": nodes,
    }
    path = folder / "best.safetensors"
    weights.save(path, sampler, {"learn": "sampler", "sampler": node}, {}, channels=channels)
    return path


def test_load_gives_the_saved_methods(tmp_path, rng):
    points = torch.rand(2, 64, 3, generator=rng)
    members = [FPSSampler(MOST, start="farthest"), FMOPSNet(16).eval(), PoissonSampler(MOST, 3)]
    saved = ByBudget([8, 16, 32], [1, 0, 2], members).eval()
    path = written(tmp_path, saved, [FPS, FMOPS, POISSON])

    for given in (path, tmp_path / "best"):  # with and without the suffix
        loaded = load(given)

        assert isinstance(loaded, ByBudget)
        assert not loaded.training
        for m in (5, 8, 16, 32, 50):
            assert torch.equal(loaded(points, m).indices, saved(points, m).indices)
            assert type(loaded.sampler_for(m)) is type(saved.sampler_for(m))


def test_load_gives_channels_to_the_samplers_that_saw_them(tmp_path, rng):
    channels = PointChannels([Channel("intensity", 100.0, 50.0)])
    members = [FPSSampler(MOST, start="farthest"), FMOPSNet(16, point_channels=channels).eval()]
    saved = ByBudget([8], [1], members, channels).eval()
    path = written(tmp_path, saved, [FPS, {**FMOPS, "sees_channels": True}], channels)

    loaded = load(path)

    points = torch.rand(2, 64, 4, generator=rng)
    assert isinstance(loaded, ByBudget)
    assert loaded.point_channels == channels
    assert loaded.sampler_for(8).point_channels == channels
    assert torch.equal(loaded(points, 8).indices, saved(points, 8).indices)


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ([FPS, {"_target_": "os.system"}], "must be a sampler of mops_lightning, got 'os.system'"),
        ([FPS, {"_target_": BEST}], "must be a sampler of mops_lightning"),
        ([FPS, 3], "must be a sampler of mops_lightning, got None"),
        ([FPS], "best must hold positions"),
        ("fps", "must begin with farthest"),
        ([FPS, {**FMOPS, "m_max": 32}], "holds another net's weights"),
        ([FPS, {**FMOPS, "no_such": 1}], "cannot build"),
    ],
)
def test_load_refuses_a_file_with_other_methods(tmp_path, nodes, said):
    saved = ByBudget([8], [1], [FPSSampler(MOST), FMOPSNet(16).eval()])
    path = written(tmp_path, saved, nodes)

    with pytest.raises(UserError, match=said):
        load(path)
