"""The combined optimizer against torch's two, each with its own parameters."""

import copy

import pytest
import torch
from torch import nn

from mops_lightning.training.muon import MuonAdam


def net(seed=0):
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, 32), nn.BatchNorm1d(32), nn.Linear(32, 48), nn.Linear(48, 4))


def train(model, optimizers, steps, first=0):
    for step in range(first, first + steps):
        x = torch.randn(16, 3, generator=torch.Generator().manual_seed(step))
        loss = model(x).square().mean()
        loss.backward()
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
    return [parameter.detach().clone() for parameter in model.parameters()]


def test_matrices_by_muon_and_the_rest_by_adam():
    plain, ours = net(), net()
    matrix = plain[2].weight
    rest = [parameter for parameter in plain.parameters() if parameter is not matrix]
    muon = torch.optim.Muon([matrix], 1e-2, weight_decay=0, adjust_lr_fn="match_rms_adamw")
    want = train(plain, [muon, torch.optim.Adam(rest, 1e-2)], 5)
    got = train(ours, [MuonAdam(ours.parameters(), lr=1e-2)], 5)
    for one, other in zip(got, want, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_restored_state_continues_to_the_same_weights():
    whole, first = net(), net()
    want = train(whole, [MuonAdam(whole.parameters())], 6)
    optimizer = MuonAdam(first.parameters())
    train(first, [optimizer], 3)
    state = copy.deepcopy(optimizer.state_dict())
    second = net(seed=1)
    second.load_state_dict(first.state_dict())
    again = MuonAdam(second.parameters())
    again.load_state_dict(state)
    got = train(second, [again], 3, first=3)
    for one, other in zip(got, want, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("layer", [0, 2])
def test_rate_of_a_group_scales_its_steps(layer):
    """A schedule and ``task_lr_scale`` set the rate of a group after construction."""
    model = net()
    before = [parameter.detach().clone() for parameter in model.parameters()]
    groups = [{"params": list(part.parameters()), "name": str(i)} for i, part in enumerate(model)]
    optimizer = MuonAdam(groups, lr=1e-2)
    optimizer.param_groups[layer]["lr"] = 0.0
    train(model, [optimizer], 1)
    still = {id(parameter) for parameter in model[layer].parameters()}
    for old, parameter in zip(before, model.parameters(), strict=True):
        assert torch.equal(old, parameter) == (id(parameter) in still)


def test_closure_is_evaluated_with_gradients():
    model = net()

    def closure():
        loss = model(torch.ones(4, 3)).square().mean()
        loss.backward()
        return loss

    optimizer = MuonAdam(model.parameters())
    first = optimizer.step(closure)
    optimizer.zero_grad()
    assert optimizer.step(closure) < first
