"""Mixed precision: half in the wide layers, single everywhere else, and in all scores."""

import json

import pytest
import torch
from torch.nn import functional as F

from mops_lightning.config.compose import compose
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.nets.pcrnet import PCRNet
from mops_lightning.nets.pointnet import FEW_POINTS, PointMaxPool, PointMLP
from mops_lightning.ops.precision import full_precision, restrict_autocast_to_pointwise
from mops_lightning.ops.rigid import Motion
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.training.run import run
from tests.support.command_line import TINY_WITH_PICTURES, call

NETS = {
    "classification": ("pointnet",),
    "registration": ("pcrnet",),
    "reconstruction": ("foldingnet", "atlasnet"),
}


def mixed(function, *arguments):
    with torch.autocast("cpu", torch.bfloat16), restrict_autocast_to_pointwise("cpu"):
        return function(*arguments)


def seen_dtypes(module, call):
    """Return the dtypes that linear layers give, by name."""
    seen = {}
    hooks = [
        layer.register_forward_hook(lambda _, __, out, name=name: seen.update({name: out.dtype}))
        for name, layer in module.named_modules()
        if isinstance(layer, torch.nn.Linear)
    ]
    call()
    for hook in hooks:
        hook.remove()
    return seen


def test_all_layers_but_the_first_are_of_half_precision(rng):
    points = torch.randn(2, 50, 3, generator=rng)
    net = PointMLP([3, 8, 16, 8])
    seen = seen_dtypes(net, lambda: mixed(net, points))
    assert list(seen.values()) == [torch.float32, torch.bfloat16, torch.bfloat16]
    assert set(seen_dtypes(net, lambda: net(points)).values()) == {torch.float32}


def test_mops_net_sees_coordinates_in_single_precision(rng):
    points = torch.randn(2, 50, 3, generator=rng)
    net = MOPSNet(8)
    seen = seen_dtypes(net, lambda: mixed(net, points))
    assert seen.pop("features.mlp.layers.0") == torch.float32
    assert set(seen.values()) == {torch.bfloat16}


def test_scores_leave_autocast(rng):
    points = torch.randn(2, 50, 3, generator=rng)
    net = MOPSNet(8).eval()
    with torch.no_grad():
        expected = net(points).points
        with torch.autocast("cpu", torch.bfloat16), full_precision("cpu"):
            assert torch.equal(net(points).points, expected)


@pytest.mark.parametrize("training", [True, False])
def test_the_sampling_matrix_and_its_points_are_of_single_precision(training, rng):
    points = F.normalize(torch.randn(4, 200, 3, generator=rng), dim=2)
    net = MOPSNet(16).train(training)
    single = net(points)
    half = mixed(net, points)
    assert half.points.dtype == half.matrix.keys.dtype == torch.float32
    dense = half.matrix.dense()
    assert dense.dtype == torch.float32
    torch.testing.assert_close(dense.sum(1), torch.ones(4, 16))
    torch.testing.assert_close(dense.mT @ points, half.points)
    assert 0 < (half.points - single.points).abs().max() < 0.02


@pytest.mark.parametrize("n", [FEW_POINTS, 100])
@pytest.mark.parametrize("norm", [True, False])
def test_the_pooled_maximum_and_its_gradients_stay_near(n, norm, rng):
    features = torch.randn(3, n, 16, generator=rng).bfloat16()
    pool = PointMaxPool(16, 64, norm)
    results, weights = [], torch.randn(3, 64, generator=rng)
    for kind in (torch.float32, torch.bfloat16):
        leaf = features.to(kind).requires_grad_()
        result = mixed(pool, leaf)
        to_leaf, to_weight = torch.autograd.grad(
            (result * weights).sum(), (leaf, pool.linear.weight)
        )
        assert result.dtype == to_weight.dtype == torch.float32
        assert to_leaf.dtype == kind
        results.append((result, to_leaf.float(), to_weight))
    # Another point may win where two are equal to three digits, so gradients are near on the whole.
    torch.testing.assert_close(results[1][0], results[0][0], rtol=0.02, atol=0.03)
    for half, single in zip(results[1][1:], results[0][1:], strict=True):
        assert F.cosine_similarity(half.flatten(), single.flatten(), dim=0) > 0.95


@pytest.mark.parametrize("task", NETS)
def test_every_net_trains_in_mixed_precision(task, tmp_path):
    for net in NETS[task]:
        common = [
            *TINY_WITH_PICTURES,
            f"task={task}",
            f"task/net={net}",
            "pictures=0",
            "logger=none",
        ]
        common += ["task.net.encoder=graph"] if net == "foldingnet" else []
        common += ["learn=joint", "weights=null", f"cache={tmp_path}/cache"]
        found = {}
        for precision in ("32-true", "bf16-mixed"):
            chosen = [*common, f"trainer.precision={precision}"]
            record = run(compose(chosen), tmp_path / net / precision, chosen)
            found[precision] = record["metrics"]["test/generated/subset_distance"]
            assert record["status"] == "completed"
        assert found["bf16-mixed"] == pytest.approx(found["32-true"], rel=0.2)
        assert found["bf16-mixed"] != found["32-true"]


def test_one_net_has_the_same_scores_whatever_the_precision(tmp_path):
    overrides = [*TINY_WITH_PICTURES, "pictures=0", "logger=none", f"cache={tmp_path}/cache"]
    status, _, err = call([*overrides, "hydra.run.dir=run"], tmp_path)
    assert status == 0, err
    for name, precision in (("single", "32-true"), ("half", "bf16-mixed")):
        arguments = ["evaluate=run", f"trainer.precision={precision}", f"hydra.run.dir={name}"]
        status, _, err = call(arguments, tmp_path)
        assert status == 0, err
    records = [json.loads((tmp_path / n / "result.json").read_text()) for n in ("single", "half")]
    assert records[0]["metrics"] == records[1]["metrics"]


@pytest.mark.parametrize("net", [PCRNet(), MFoldingNet(64, 4, 64), MFoldingNet(64, 1, 64, "graph")])
def test_nets_alone_can_be_put_under_autocast(net, rng):
    points = torch.randn(4, 60, 3, generator=rng)
    arguments = (points, points + 0.1) if isinstance(net, PCRNet) else (points,)
    results = []
    for mixed in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            made = net(*arguments)
        result = (made.quaternion if isinstance(made, Motion) else made).float()
        net.zero_grad()
        result[..., 1].sum().backward()
        gradients = [p.grad.flatten() for p in net.parameters() if p.grad is not None]
        results.append((result.detach(), torch.cat(gradients)))
    torch.testing.assert_close(results[1][0], results[0][0], rtol=0.05, atol=0.05)
    assert F.cosine_similarity(results[1][1], results[0][1], dim=0) > 0.9


def test_a_precision_that_only_gpus_have_is_refused_on_a_cpu(tmp_path):
    status, _, err = call([*TINY_WITH_PICTURES, "trainer.precision=16-mixed"], tmp_path)
    assert status != 0
    assert "take bf16-mixed" in err


@pytest.mark.parametrize("precision", ["bf16-true", "64-true", "transformer-engine", "half"])
def test_precisions_that_round_coordinates_are_refused(precision, tmp_path):
    status, _, err = call([*TINY_WITH_PICTURES, f"trainer.precision={precision}"], tmp_path)
    assert status != 0
    assert "trainer.precision must be one of 32-true, bf16-mixed, 16-mixed" in err
    assert precision in err
