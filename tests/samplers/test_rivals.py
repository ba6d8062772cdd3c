from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir

from mops_lightning.config.build import build
from mops_lightning.config.compose import conf_dir

rivals: Any = import_module("benchmarks.rivals")  # from the repository's root, as for sampler=NAME
SWEEPS = Path(__file__).parents[2] / "sweeps"


@pytest.mark.parametrize("choice", ["lightn"])
def test_rival_trains_every_weight_and_ignores_order_of_points(choice, rng):
    settings = [f"hydra.searchpath=[file://{conf_dir()}]", "m=6", *f"sampler={choice}".split()]
    with initialize_config_dir(str(SWEEPS), version_base="1.3"):
        sampler = build(compose("noise", settings).sampler, "sampler")
    points, order = torch.randn(3, 50, 3, generator=rng), torch.randperm(50, generator=rng)
    output = sampler(points)
    seen = output.points if output.soft_projected is None else output.soft_projected
    (seen.square().sum() + sum(output.losses.values())).backward()
    assert all(p.grad is not None and p.grad.any() for p in sampler.parameters())
    chosen, turned = sampler.eval()(points), sampler(points[:, order])
    assert chosen.points.shape == (3, 6, 3)
    torch.testing.assert_close(turned.points, chosen.points, atol=1e-4, rtol=1e-4)
    assert sampler.generates or torch.equal(order[turned.indices], chosen.indices)


def test_self_correlation_equals_plain_sums(rng):
    cloud = torch.randn(7, 4, generator=rng)
    for row, got in zip(cloud, rivals.self_correlation(cloud[None])[0], strict=True):
        shares = (cloud * row).sum(1).div(2).exp()
        torch.testing.assert_close(got, (shares[:, None] * cloud).sum(0) / shares.sum())
