import numpy as np
import pytest

from mops_lightning.errors import UserError
from mops_lightning.ops import weights
from mops_lightning.ops.weights import LEAST, NEIGHBOURS, check_weight, curvature


@pytest.mark.parametrize(
    ("weight", "said"),
    [
        ([[1.0, 2.0]], r"one number per point, shape \(2,\), got torch.float64 of shape \(1, 2\)"),
        ([1.0], r"shape \(2,\)"),
        ([1.0, -2.0], r"at least 0, got -2\.0 in row 1"),
        ([np.nan, 1.0], "finite and at least 0, got nan in row 0"),
        ([1.0, np.inf], "finite and at least 0, got inf in row 1"),
        (["a", "b"], "must hold numbers"),
    ],
)
def test_weight_that_is_none_is_rejected(weight, said):
    with pytest.raises(UserError, match=said):
        check_weight(np.array(weight), (2,))


def test_curvature_equals_definition_for_every_point(monkeypatch):
    monkeypatch.setattr(weights, "PART", 40)
    points = np.random.default_rng(0).normal(size=(90, 3))
    for point, value in zip(points, curvature(points), strict=True):
        near = points[((points - point) ** 2).sum(1).argsort()[:NEIGHBOURS]]
        values = np.linalg.eigvalsh(np.cov(near.T))
        assert value == pytest.approx(values[0] / values.sum())


def test_curvature_is_least_in_a_plane_and_for_equal_points(rand):
    plane = rand(60, 3).numpy() * [1, 1, 0]
    assert curvature(plane) == pytest.approx(np.full(60, LEAST))
    assert curvature(np.ones((5, 3))) == pytest.approx(np.full(5, LEAST))
