"""The combined optimizer against torch's two, each with its own parameters."""

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
        nn.Linear(48, 4),
    )


def test_matrices_by_muon_and_the_rest_by_adam():
    plain = net()
    ours = net()
    matrix = plain[2].weight
    start = matrix.detach().clone()
    rest = [parameter for parameter in plain.parameters() if parameter is not matrix]
    muon = torch.optim.Muon([matrix], 1e-2, weight_decay=0, adjust_lr_fn="match_rms_adamw")
    adam = torch.optim.Adam(rest, 1e-2)
    both = MuonAdam(ours.parameters(), lr=1e-2)

    for _ in range(5):
        for expected, parameter in zip(plain.parameters(), ours.parameters(), strict=True):
            expected.grad = torch.randn_like(expected)
            parameter.grad = expected.grad.clone()
        muon.step()
        adam.step()
        both.step()

    for expected, parameter in zip(plain.parameters(), ours.parameters(), strict=True):
        if expected is not matrix:
            torch.testing.assert_close(parameter, expected, rtol=0, atol=0)
    # torch iterates in bfloat16, which has 8 bits.
    assert (ours[2].weight - matrix).norm() < 0.02 * (matrix - start).norm()


@pytest.mark.parametrize("shape", [(32, 48), (48, 32), (64, 64), (32, 1024)])
def test_orthogonalised_keeps_singular_vectors_and_brings_values_near_one(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    scaled = values / values.square().sum().sqrt()
    for _ in range(5):
        scaled = 3.4445 * scaled - 4.7750 * scaled**3 + 2.0315 * scaled**5
    assert scaled[values > 0.1 * values[0]].sub(1).abs().max() < 0.4
    got = orthogonalised(matrix)
    torch.testing.assert_close(got, (left * scaled) @ right, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(orthogonalised(1000 * matrix), got, rtol=1e-4, atol=1e-4)


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
