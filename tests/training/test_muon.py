"""The combined optimizer against torch's two, each with its own parameters."""

import copy

import pytest
import torch
from torch import nn

from mops_lightning.training.muon import MuonAdam, orthogonalised


def net(seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(
        nn.Linear(3, 32),
        nn.BatchNorm1d(32),
        nn.Linear(32, 48),
        nn.Linear(48, 32),
        nn.Linear(32, 4),
    )


MATRICES = ("2.weight", "3.weight")
"""The parameters of ``net`` with at least 32 rows and columns: one is tall, one is wide."""


@pytest.mark.parametrize(
    ("of_muon", "of_adam"),
    [
        ({}, {}),
        ({"momentum": 0.7}, {"betas": (0.6, 0.9)}),
    ],
    ids=["defaults", "given"],
)
def test_matrices_by_muon_and_the_rest_by_adam(of_muon, of_adam):
    plain = net()
    ours = net()
    starts = copy.deepcopy(plain.state_dict())
    matrices = []
    rest = []
    for name, parameter in plain.named_parameters():
        if name in MATRICES:
            matrices.append(parameter)
        else:
            rest.append(parameter)
    muon = torch.optim.Muon(
        matrices, 1e-2, weight_decay=0, adjust_lr_fn="match_rms_adamw", **of_muon
    )
    adam = torch.optim.Adam(rest, 1e-2, **of_adam)
    both = MuonAdam(ours.parameters(), lr=1e-2, **of_muon, **of_adam)

    for _ in range(5):
        for expected, parameter in zip(plain.parameters(), ours.parameters(), strict=True):
            expected.grad = torch.randn_like(expected)
            parameter.grad = expected.grad.clone()
        muon.step()
        adam.step()
        both.step()

    for name, expected in plain.named_parameters():
        parameter = ours.get_parameter(name)
        if name in MATRICES:
            moved = expected - starts[name]
            difference = parameter - expected
            # torch iterates in bfloat16, which has 8 bits.
            assert difference.norm() < 0.02 * moved.norm()
        else:
            torch.testing.assert_close(parameter, expected, rtol=0, atol=0)


@pytest.mark.parametrize("shape", [(32, 48), (48, 32), (64, 64), (32, 1024)])
def test_orthogonalised_keeps_singular_vectors_and_brings_values_near_one(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    scaled = values / values.square().sum().sqrt()
    for _ in range(5):
        scaled = 3.4445 * scaled - 4.7750 * scaled**3 + 2.0315 * scaled**5
    is_large = values > 0.1 * values[0]
    assert scaled[is_large].sub(1).abs().max() < 0.4
    expected = (left * scaled) @ right

    result = orthogonalised(matrix)
    of_scaled = orthogonalised(1000 * matrix)

    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(of_scaled, result, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("layer", [0, 2])
def test_rate_of_a_group_scales_its_steps(layer):
    """A schedule and ``task_lr_scale`` set the rate of a group after construction."""
    model = net()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    groups = [{"params": list(part.parameters())} for part in model]
    optimizer = MuonAdam(groups, lr=1e-2)
    optimizer.param_groups[layer]["lr"] = 0.0
    model(torch.randn(16, 3)).square().mean().backward()

    optimizer.step()

    for name, parameter in model.named_parameters():
        is_still = name.startswith(f"{layer}.")
        assert torch.equal(before[name], parameter) == is_still


def test_closure_is_evaluated_with_gradients():
    model = net()

    def closure():
        loss = model(torch.ones(4, 3)).square().mean()
        loss.backward()
        return loss

    optimizer = MuonAdam(model.parameters())
    first = optimizer.step(closure)
    optimizer.zero_grad()
    second = optimizer.step(closure)

    assert second < first
