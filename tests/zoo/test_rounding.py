"""Weight matrices in 8 bits: a scale for each row."""

import pytest
import torch

from mops_lightning.zoo.rounding import restored, rounded


def matrix():
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(64, 64, generator=generator)
    values[1] *= 1000
    values[2] = 0
    values[3] = 1e-40  # not a normal number
    return values


def test_entries_differ_by_half_a_step_of_their_row_at_most():
    values = matrix()

    stored = rounded({"net.weight": values}, "int8")

    assert stored["net.weight"].dtype == torch.int8
    assert set(stored) == {"net.weight", "net.weight.scale"}
    back = restored(stored)
    assert set(back) == {"net.weight"}
    largest = values.abs().amax(dim=1, keepdim=True)
    error = (back["net.weight"] - values).abs()
    assert bool((error <= largest / 254 * (1 + 1e-5) + 1e-44).all())
    kept = back["net.weight"].abs().amax(dim=1, keepdim=True)
    torch.testing.assert_close(kept, largest)


def test_what_was_rounded_once_stays():
    stored = rounded({"net.weight": matrix()}, "int8")
    again = rounded(restored(stored), "int8")
    assert torch.equal(again["net.weight"], stored["net.weight"])


@pytest.mark.parametrize("precision", ["float32", "float16", "bfloat16", "int8"])
def test_narrow_matrices_and_other_tensors_stay(precision):
    state = {
        "bias": torch.randn(5000),
        "narrow.weight": torch.randn(64, 63),
        "count": torch.tensor(3),
    }
    assert rounded(state, precision) == state


@pytest.mark.parametrize(
    "scale", [torch.ones(64), torch.ones(63, 1), torch.ones(64, 1).double()], ids=str
)
def test_a_matrix_with_another_scale_stays(scale):
    state = {"weight": torch.ones(64, 64, dtype=torch.int8), "weight.scale": scale}
    assert restored(state) == state


def test_tensors_without_bits_to_restore_stay():
    state = {"weight": torch.randn(64, 64), "weight.scale": torch.ones(64, 1)}
    assert restored(state) == state
