"""Maxima over points and neighbourhoods."""

import pytest
import torch

from mops_lightning.ops import compiled
from mops_lightning.ops.maxima import max_of_points, max_of_rows
from mops_lightning.ops.points import gather_points


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_max_of_points_equals_amax_and_so_do_its_gradients(dtype, randn):
    without_ties = randn(3, 50, 7).argsort(1) - 25  # tied points share the gradient of amax
    features = without_ties.to(dtype).requires_grad_()
    given = randn(3, 7).to(dtype)

    largest = max_of_points(features)

    expected = features.amax(1)
    assert largest.equal(expected)
    (gradient,) = torch.autograd.grad(largest, features, given)
    (expected_gradient,) = torch.autograd.grad(expected, features, given)
    assert gradient.equal(expected_gradient)


def test_max_of_points_gives_the_gradient_of_tied_points_to_the_first():
    features = torch.tensor([[[1.0], [2.0], [2.0]]], requires_grad=True)

    max_of_points(features).sum().backward()

    assert features.grad is not None
    assert features.grad.flatten().tolist() == [0.0, 1.0, 0.0]


def test_max_of_points_passes_on_what_is_not_a_number():
    features = torch.tensor([[[1.0, 3.0], [float("nan"), 2.0]]])

    largest = max_of_points(features)

    assert largest[0, 0].isnan()
    assert largest[0, 1] == 3.0


def test_max_of_points_on_a_cpu_ignores_the_default_device():
    features = torch.tensor([[[1.0], [2.0]]])
    torch.set_default_device("meta")
    try:
        largest = max_of_points(features)
    finally:
        torch.set_default_device(None)

    assert largest.tolist() == [[2.0]]


def test_max_of_rows_without_compiled_loops_is_that_of_gathered_rows(rng, randn, monkeypatch):
    monkeypatch.setattr(compiled, "winners", lambda *_: None)
    features = randn(3, 20, 6, requires_grad=True)
    rows = torch.randint(20, (3, 9, 4), generator=rng)

    maxima = max_of_rows(features, rows)

    expected = gather_points(features, rows).amax(2)
    assert maxima.equal(expected)
    direction = randn(maxima.shape)
    (gradient,) = torch.autograd.grad(maxima, features, direction)
    (expected_gradient,) = torch.autograd.grad(expected, features, direction)
    torch.testing.assert_close(gradient, expected_gradient)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16, torch.bfloat16])
def test_max_of_rows_equals_that_of_gathered_rows(dtype, rng, randn, monkeypatch):
    monkeypatch.setattr(compiled, "THREADS_MIN_WORK", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    features = randn(3, 20, 6).to(dtype).requires_grad_()
    rows = torch.randint(20, (3, 9, 4), generator=rng)

    maxima = max_of_rows(features, rows)

    gathered = gather_points(features, rows)
    assert maxima.dtype == dtype
    assert maxima.equal(gathered.amax(2))
    winners = gathered.argmax(2, keepdim=True)
    direction = randn(maxima.shape).to(dtype)
    (gradient,) = torch.autograd.grad(maxima, features, direction)
    of_winners = gathered.gather(2, winners)[:, :, 0]
    (expected_gradient,) = torch.autograd.grad(of_winners, features, direction)
    torch.testing.assert_close(gradient, expected_gradient)
