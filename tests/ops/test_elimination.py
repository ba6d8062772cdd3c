"""Which clouds are eliminated by cells; the rows are compared with the plain form elsewhere."""

import pytest
import torch

from mops_lightning.ops import compiled
from mops_lightning.ops.elimination import eliminate_by_cells

SCALE = 2.0**50


@pytest.mark.parametrize("reach", [1e-3, 0.3, 10.0])
def test_eliminate_by_cells_is_for_finite_points_in_space(reach, rng):
    pytest.importorskip("numba", reason="needs mops-lightning[fast]")
    points = torch.rand(50, 3, generator=rng, dtype=torch.float64)
    kept = eliminate_by_cells(points, 20, reach, SCALE)
    assert kept is not None
    assert len(kept.unique()) == 20
    assert eliminate_by_cells(points[:, :2], 20, reach, SCALE) is None
    for wrong in (torch.nan, torch.inf):
        points[7, 1] = wrong
        assert eliminate_by_cells(points, 20, reach, SCALE) is None


def test_eliminate_by_cells_without_numba_is_none(rng, monkeypatch):
    monkeypatch.setattr(compiled, "kernels", lambda: None)
    assert eliminate_by_cells(torch.rand(9, 3, generator=rng).double(), 4, 0.3, SCALE) is None
