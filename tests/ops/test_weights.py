import numpy as np
import pytest

from mops_lightning.errors import UserError
from mops_lightning.ops import weights
from mops_lightning.ops.weights import check_weight, curvature


@pytest.mark.parametrize(
    ("weight", "said"),
    [
        ([[1.0, 2.0]], r"one number per point, shape \(2,\), got torch.float64 of shape \(1, 2\)"),
        ([1.0], r"shape \(2,\)"),
        ([1.0, -2.0], r"at least 0, got -2\.0 in row 1"),
        ([np.nan, 1.0], "finite and at least 0, got nan in row 0"),
        ([1.0, np.inf], "finite and at least 0, got inf in row 1"),
        ([1.0, 2.0j], "weight must hold real numbers, got torch.complex128. Try weight.real"),
        (["a", "b"], "must hold numbers"),
    ],
)
def test_weight_that_is_none_is_rejected(weight, said):
    with pytest.raises(UserError, match=said):
        check_weight(np.array(weight), (2,))


def test_curvature_equals_definition_for_every_point(monkeypatch):
    monkeypatch.setattr(weights, "PART", 40)
    points = np.random.default_rng(0).normal(size=(90, 3))

    found = curvature(points)

    for point, value in zip(points, found, strict=True):
        distances = np.linalg.norm(points - point, axis=1)
        nearest = distances.argsort()[:16]
        variances = np.linalg.eigvalsh(np.cov(points[nearest].T))
        assert value == pytest.approx(variances[0] / variances.sum())


def test_weights_of_zero_are_accepted():
    weight = check_weight(np.array([0.0, 2.0]), (2,))

    assert weight.tolist() == [0.0, 2.0]


def test_curvature_is_least_in_a_plane_and_for_equal_points(rand):
    plane = rand(60, 3).numpy()
    plane[:, 2] = 0
    equal = np.ones((5, 3))

    of_plane = curvature(plane)
    of_equal = curvature(equal)

    assert of_plane == pytest.approx(0.001)
    assert of_equal == pytest.approx(0.001)
