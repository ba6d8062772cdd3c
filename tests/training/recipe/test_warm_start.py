"""A run whose sampler starts from the task net or from another run's sampler."""

import copy
from typing import Any

import pytest
import torch
from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.nets.layers import PointFeatures, PointMLP
from mops_lightning.records import run_record
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.samplenet import SampleNet
from mops_lightning.training.recipe.warm_start import (
    copy_pointwise_layers,
    copy_tensors,
    warm_start_sampler,
)
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call

SIZES: Any = {"feature_channels": (8, 8), "rho_channels": (16, 8)}
POINTS = torch.randn(4, 60, 3, generator=torch.Generator().manual_seed(0))


def run(tmp_path, name, *overrides):
    settings = [
        *TINY,
        "weights=null",
        "recipe.ema_span=null",
        f"hydra.run.dir={tmp_path / name}",
    ]
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
    first = weights.read(folder / weights.FILE)
    second = weights.read(tmp_path / "second" / weights.FILE)
    rows = first["state"]["queries.weight"][:5]
    torch.testing.assert_close(second["state"]["queries.weight"], rows)
    record = run_record.read(tmp_path / "second")
    assert record.warm_start == {"sha256": first["sha256"], "tensors": len(first["state"])}

    start = f"recipe.warm_start={folder / 'weights.safetensors'}"
    status, _, err = run(tmp_path, "third", "sampler=snet", start)

    assert status != 0
    assert "recipe.warm_start: no tensor of" in err

    start = f"recipe.warm_start={tmp_path / 'nothing.pt'}"
    status, _, err = run(tmp_path, "fourth", start)

    assert status != 0
    assert "recipe.warm_start: no file" in err


@pytest.mark.parametrize(
    ("features", "rho", "copied", "left"),
    [
        (8, 4, 25, "rho.0.weight"),
        (
            6,
            4,
            21,
            "features.mlp.layers.3.weight, rho_local.weight, rho_global.weight, ...",
        ),
    ],
    ids=["one", "more than three"],
)
def test_warm_start_names_the_tensors_that_are_not_copied(features, rho, copied, left, tmp_path):
    file = tmp_path / weights.FILE
    weights.save(file, MOPSNet(8, **SIZES), {"learn": "sampler"}, {})
    target = MOPSNet(8, feature_channels=(features, features), rho_channels=(rho, features))

    numbers, text = warm_start_sampler(str(file), target, nn.Linear(3, 3), POINTS)

    assert numbers["tensors"] == copied
    assert text == f"{copied} of 26 tensors are copies of {file}; not copied: {left}"


def test_warm_start_from_a_task_net_is_refused(tmp_path):
    weights.save(tmp_path / weights.FILE, nn.Linear(3, 3), {"learn": "task"}, {})

    with pytest.raises(UserError, match=r"recipe\.warm_start: .* holds a task net"):
        warm_start_sampler(
            str(tmp_path / weights.FILE), MOPSNet(8, **SIZES), nn.Linear(3, 3), POINTS
        )


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
        layer, _, _ = name.partition(".")
        expected = before[name]
        if int(layer) < 9:  # three times linear layer, BatchNorm and ReLU
            expected = original[name]
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


def test_copy_tensors_takes_single_numbers():
    source = SampleNet(8)
    target = SampleNet(4)
    with torch.no_grad():
        source.temperature.fill_(0.5)

    copied = copy_tensors(source.state_dict(), target)

    assert "temperature" in copied
    assert target.temperature.item() == 0.5


def test_copy_tensors_leaves_other_shapes_and_names():
    source = nn.Linear(3, 4)
    target = nn.Linear(5, 4)
    before = target.weight.clone()

    copied = copy_tensors(source.state_dict(), target)

    assert copied == ["bias"]
    assert torch.equal(target.weight, before)
    assert copy_tensors({"other": torch.ones(4)}, target) == []
