import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning import SampleOutput, SamplingMatrix
from mops_lightning.metrics.sampled_set import SET_METRICS


def values(name, points, output):
    """The metric of all m samples; that of the first 2 must equal a set of 2."""
    m = output.points.shape[1]
    found = SET_METRICS[name].measure(points, output, (m, 2))
    if found is None:
        return None
    head = SET_METRICS[name].measure(points, output.first(2), (2,)) or {}
    torch.testing.assert_close(found[2], head[2])
    return found[m]


@pytest.fixture
def clouds(rng):
    return torch.randn(3, 40, 3, generator=rng)


def test_subset_distance_matches_kd_tree(clouds, rng):
    samples = torch.randn(3, 7, 3, generator=rng)
    got = values("generated/subset_distance", clouds, SampleOutput(samples, None, {}))
    want = [
        np.square(cKDTree(c.numpy()).query(s.numpy())[0]).mean()
        for c, s in zip(clouds, samples, strict=True)
    ]
    torch.testing.assert_close(got, torch.tensor(want, dtype=torch.float32))


def test_unique_points_counts_each_match_or_index_once(clouds):
    samples = torch.stack([clouds[:, 4], clouds[:, 4], clouds[:, 9] + 1e-4], 1)
    got = values("matched/unique_points", clouds, SampleOutput(samples, None, {}))
    assert got.tolist() == [2, 2, 2]
    indices = torch.tensor([[0, 1, 1, 2]] * 3)
    output = SampleOutput(clouds[:, indices[0]], indices, {})
    assert values("matched/unique_points", clouds, output).tolist() == [3, 3, 3]


def test_matrix_metrics_match_ideal_and_uniform_matrix(clouds):
    keys = torch.eye(40).expand(3, 40, 40)
    ideal = SamplingMatrix(torch.eye(40)[:5], keys, 1e-3)
    uniform = SamplingMatrix(torch.zeros(5, 40), keys, 1.0)
    samples = clouds[:, :5]
    for matrix, percent, error in ((ideal, 100 / 40, 0.0), (uniform, 100.0, None)):
        output = SampleOutput(samples, None, {}, matrix)
        found = values("matrix/nonzero_percent", clouds, output)
        assert found.tolist() == pytest.approx([percent] * 3)
        # SᵀS of the uniform matrix is 1/40 everywhere.
        want = error if error is not None else (5 * (1 - 1 / 40) ** 2 + 20 / 40**2) ** 0.5
        got = values("matrix/orthogonality_error", clouds, output)
        torch.testing.assert_close(got, torch.full((3,), want), atol=1e-5, rtol=1e-5)


def test_nonzero_percent_counts_each_column(clouds):
    # Column j of S has j + 1 equal entries.
    columns = 50 * torch.ones(5, 40).tril()
    matrix = SamplingMatrix(columns, torch.eye(40).expand(3, 40, 40), 1.0)
    output = SampleOutput(clouds[:, :5], None, {}, matrix)
    found = SET_METRICS["matrix/nonzero_percent"].measure(clouds, output, (5, 2)) or {}
    assert found[5].tolist() == pytest.approx([100 * (1 + 2 + 3 + 4 + 5) / 5 / 40] * 3)
    assert found[2].tolist() == pytest.approx([100 * (1 + 2) / 2 / 40] * 3)


def test_set_metric_of_nan_is_nan():
    for metric in SET_METRICS.values():
        mean = metric()
        mean.update(torch.tensor([1.0, float("nan")]))
        assert mean.compute().isnan()


def test_matrix_metrics_without_matrix_are_none(clouds):
    output = SampleOutput(clouds[:, :5], None, {})
    assert values("matrix/nonzero_percent", clouds, output) is None
    assert values("matrix/orthogonality_error", clouds, output) is None
