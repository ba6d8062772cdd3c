from typing import Any

import pytest
import torch

from mops_lightning.errors import UserError
from mops_lightning.training.schedules import exponential, one_cycle, step_decay


def rates(make, steps, lr=1.0, **settings):
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=lr)
    schedule = make(optimizer, steps, **settings)
    seen = []
    for _ in range(steps):
        seen.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return seen


def test_exponential_spans_first_to_last_rate():
    seen = rates(exponential, 101, lr=5e-4, end_lr=1e-5)

    geometric_mean = (5e-4 * 1e-5) ** 0.5
    assert seen[0] == pytest.approx(5e-4)
    assert seen[50] == pytest.approx(geometric_mean)
    assert seen[100] == pytest.approx(1e-5)


def test_step_decay_halves_the_rate_down_to_its_floor():
    seen = rates(step_decay, 10, every=2, factor=0.5, floor_lr=0.2)

    assert seen == pytest.approx([1, 1, 0.5, 0.5, 0.25, 0.25, 0.2, 0.2, 0.2, 0.2])


def test_step_decay_floor_is_a_rate_and_no_share_of_the_first_one():
    seen = rates(step_decay, 6, lr=0.5, every=2, factor=0.5, floor_lr=0.2)

    assert seen == pytest.approx([0.5, 0.5, 0.25, 0.25, 0.2, 0.2])


def test_exponential_ends_at_the_rate_of_the_first_group_and_stays_there():
    """In joint training, the second group is the task net's, with a rate of its own."""
    sampler = torch.nn.Parameter(torch.zeros(1))
    task = torch.nn.Parameter(torch.zeros(1))
    groups = [{"params": [sampler], "lr": 1e-2}, {"params": [task], "lr": 1e-3}]
    optimizer = torch.optim.SGD(groups)
    schedule = exponential(optimizer, 5, end_lr=1e-4)
    seen = []

    for _ in range(7):
        seen.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        schedule.step()

    assert seen[0] == pytest.approx([1e-2, 1e-3])
    assert seen[4:] == [pytest.approx([1e-4, 1e-5])] * 3


def test_one_cycle_equals_torch():
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    form: dict[str, Any] = {"pct_start": 0.3, "cycle_momentum": False, "final_div_factor": 400}
    reference = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1.0, 51, **form)
    want = []
    for _ in range(51):
        want.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        if len(want) < 51:
            reference.step()

    assert rates(one_cycle, 51) == pytest.approx(want)


def test_one_cycle_stays_at_its_last_rate():
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = one_cycle(optimizer, 10)

    seen = []
    for _ in range(15):
        seen.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()

    assert seen[9:] == pytest.approx([1e-4] * 6)


@pytest.mark.parametrize(
    ("make", "name", "value"),
    [
        (one_cycle, "warmup", -0.1),
        (one_cycle, "warmup", 2.0),
        (exponential, "end_lr", 0.0),
        (step_decay, "every", 0),
        (step_decay, "factor", 0.0),
        (step_decay, "factor", 2.0),
    ],
)
def test_schedule_argument_out_of_range_raises(make, name, value):
    settings: dict[str, Any] = {}
    if make is step_decay:
        settings = {"every": 2, "factor": 0.5, "floor_lr": 0.0}
    settings[name] = value

    with pytest.raises(UserError, match=f"^{name} must be .*, got {value}"):
        rates(make, 5, **settings)
