"""A run whose sampler starts from the task net or from another run's sampler."""

import copy
import json
from typing import Any

import torch
from torch import nn

from mops_lightning.nets.layers import PointFeatures, PointMLP
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.training.recipe.warm_start import copy_pointwise_layers, copy_tensors
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call

SIZES: Any = {"feature_channels": (8, 8), "rho_channels": (16, 8)}
POINTS = torch.randn(4, 60, 3, generator=torch.Generator().manual_seed(0))


def run(tmp_path, name, *overrides):
    settings = [*TINY, "weights=null", "recipe.ema_span=null", f"hydra.run.dir={tmp_path / name}"]
    return call([*settings, *overrides], tmp_path)


def test_sampler_of_another_size_continues_from_a_run(tmp_path):
    status, out, err = run(tmp_path, "first", "sampler=mops", "m=8")

    assert (status, err) == (0, "")
    assert "Warm start: the first" in out

    folder = tmp_path / "first"
    start = f"recipe.warm_start={folder}"
    status, out, _ = run(tmp_path, "second", "m=5", start, "optimizer.lr=1e-12")

    assert status == 0
    assert f"tensors are copies of {folder}." in out
    first = weights.read(folder / "weights.safetensors")
    second = weights.read(tmp_path / "second" / "weights.safetensors")
    rows = first["state"]["queries.weight"][:5]
    torch.testing.assert_close(second["state"]["queries.weight"], rows)
    record = json.loads((tmp_path / "second" / "result.json").read_text())
    assert record["warm_start"]["sha256"] == first["sha256"]

    start = f"recipe.warm_start={folder / 'weights.safetensors'}"
    status, _, err = run(tmp_path, "third", "sampler=snet", start)

    assert status != 0
    assert "recipe.warm_start: no tensor of" in err

    start = f"recipe.warm_start={tmp_path / 'nothing.pt'}"
    status, _, err = run(tmp_path, "fourth", start)

    assert status != 0
    assert "recipe.warm_start: no file" in err


def test_copy_pointwise_layers_copies_until_shapes_differ():
    source = PointMLP([3, 8, 8, 16, 32])
    source(POINTS)  # moves the running statistics
    target = PointFeatures(PointMLP([3, 8, 8, 16, 16]))
    before = copy.deepcopy(target.mlp.layers.state_dict())
    net = nn.Sequential(nn.Linear(3, 3), source)

    copied = copy_pointwise_layers(net, target, POINTS)

    assert copied == 3
    original = source.layers.state_dict()
    for name, value in target.mlp.layers.state_dict().items():
        layer = int(name.split(".")[0])
        is_copied = layer < 9  # three times linear layer, BatchNorm and ReLU
        expected = original[name] if is_copied else before[name]
        assert torch.equal(value, expected), name
    with torch.no_grad():
        next(source.parameters()).zero_()
    assert next(target.parameters()).any()  # a copy, not the same tensor


def test_copy_pointwise_layers_without_batch_norm_computes_the_same():
    source = PointMLP([3, 8, 8, 16], norm=False)
    target = PointMLP([3, 8, 8, 16])

    copied = copy_pointwise_layers(source, target, POINTS)

    assert copied == 3
    for mode in (False, True):  # in training, with the statistics of the same points
        target.train(mode)
        torch.testing.assert_close(target(POINTS), source(POINTS), rtol=1e-4, atol=1e-5)


def test_copy_pointwise_layers_without_counterpart_copies_none():
    normed = PointMLP([3, 8])
    plain = PointMLP([3, 8], norm=False)
    narrow = PointMLP([3, 4])

    assert copy_pointwise_layers(nn.Linear(3, 8), normed, POINTS) == 0
    assert copy_pointwise_layers(normed, narrow, POINTS) == 0
    assert copy_pointwise_layers(normed, plain, POINTS) == 0


def test_copy_tensors_takes_the_rows_that_both_have():
    large = MOPSNet(12, **SIZES)
    small = MOPSNet(8, **SIZES)
    for source, other in ((large, small), (small, large)):
        target = copy.deepcopy(other)
        before = copy.deepcopy(target.state_dict())
        state = source.state_dict()

        copied = copy_tensors(state, target)

        assert set(copied) == set(state)
        rows = target.queries.weight
        assert torch.equal(rows[:8], source.queries.weight[:8])
        assert torch.equal(rows[8:], before["queries.weight"][8:])
        assert torch.equal(target.rho_local.weight, source.rho_local.weight)


def test_copy_tensors_leaves_other_shapes_and_names():
    source = nn.Linear(3, 4)
    target = nn.Linear(5, 4)
    before = target.weight.clone()

    copied = copy_tensors(source.state_dict(), target)

    assert copied == ["bias"]
    assert torch.equal(target.weight, before)
    assert copy_tensors({"other": torch.ones(4)}, target) == []
