import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch.testing import assert_close

from mops_lightning import SampleOutput, SamplingMatrix
from mops_lightning.metrics.sampled_set import SET_METRICS


def values(name, points, output):
    """The metric of all m samples; that of the first 2 must equal a set of 2."""
    metric = SET_METRICS[name]
    m = output.points.shape[1]
    found = metric.measure(points, output, (m, 2))
    if found is None:
        return None
    of_two = metric.measure(points, output.first(2), (2,))
    assert of_two is not None
    assert_close(found[2], of_two[2])
    return found[m]


def generated(points):
    """A set of points that were not chosen by their rows."""
    return SampleOutput(points, None, {})


@pytest.fixture
def clouds(randn):
    return randn(3, 40, 3)


def test_subset_distance_matches_kd_tree(clouds, randn):
    samples = randn(3, 7, 3)
    output = generated(samples)

    found = values("generated/subset_distance", clouds, output)

    expected = []
    for cloud, sample in zip(clouds, samples, strict=True):
        distances, _ = cKDTree(cloud).query(sample)
        expected.append(np.square(distances).mean())
    assert found.tolist() == pytest.approx(expected, rel=1e-5)


def test_subset_distance_is_between_coordinates(clouds, randn):
    samples = randn(3, 7, 3)
    with_channels = torch.cat([clouds, 9 * randn(3, 40, 2)], 2)
    samples_with_channels = torch.cat([samples, 9 * randn(3, 7, 2)], 2)

    found = values("generated/subset_distance", with_channels, generated(samples_with_channels))

    expected = values("generated/subset_distance", clouds, generated(samples))
    assert_close(found, expected)


def test_unique_points_counts_each_match_once(clouds):
    near = clouds[:, 9] + 1e-4
    samples = torch.stack([clouds[:, 4], clouds[:, 4], near], 1)
    output = generated(samples)

    numbers = values("matched/unique_points", clouds, output)

    assert numbers.tolist() == [2, 2, 2]


def test_unique_points_counts_each_index_once(clouds):
    rows = torch.tensor([0, 1, 1, 2])
    output = SampleOutput(clouds[:, rows], rows.expand(3, 4), {})

    numbers = values("matched/unique_points", clouds, output)

    assert numbers.tolist() == [3, 3, 3]


def output_of_matrix(clouds, queries, tau):
    keys = torch.eye(40).expand(3, 40, 40)
    matrix = SamplingMatrix(queries, keys, tau)
    return SampleOutput(clouds[:, :5], None, {}, matrix)


def test_matrix_metrics_match_ideal_matrix(clouds):
    output = output_of_matrix(clouds, torch.eye(40)[:5], 1e-3)

    percent = values("matrix/nonzero_percent", clouds, output)
    error = values("matrix/orthogonality_error", clouds, output)

    one_of_40 = 100 / 40
    assert percent.tolist() == pytest.approx([one_of_40, one_of_40, one_of_40])
    assert_close(error, torch.zeros(3), atol=1e-5, rtol=1e-5)


def test_matrix_metrics_match_uniform_matrix(clouds):
    output = output_of_matrix(clouds, torch.zeros(5, 40), 1.0)

    percent = values("matrix/nonzero_percent", clouds, output)
    error = values("matrix/orthogonality_error", clouds, output)

    # SᵀS is 1/40 everywhere.
    diagonal = 5 * (1 - 1 / 40) ** 2
    off_diagonal = 20 / 40**2
    expected = (diagonal + off_diagonal) ** 0.5
    assert percent.tolist() == pytest.approx([100, 100, 100])
    assert_close(error, torch.full((3,), expected), atol=1e-5, rtol=1e-5)


def test_nonzero_percent_leaves_out_entries_below_a_hundredth(clouds):
    columns = torch.zeros(5, 40)
    columns[:, 7] = math.log(161)  # an entry of 161/200, and 39 of 1/200
    output = output_of_matrix(clouds, columns, 1.0)

    percent = values("matrix/nonzero_percent", clouds, output)

    one_of_40 = 100 / 40
    assert percent.tolist() == pytest.approx([one_of_40, one_of_40, one_of_40])


def test_nonzero_percent_counts_entries_above_a_hundredth(clouds):
    columns = torch.zeros(5, 40)
    columns[:, 7] = math.log(0.532 / 0.012)  # an entry of 0.532, and 39 of 0.012
    output = output_of_matrix(clouds, columns, 1.0)

    percent = values("matrix/nonzero_percent", clouds, output)

    assert percent.tolist() == pytest.approx([100, 100, 100])


def test_nonzero_percent_counts_each_column(clouds):
    # Column j of S has j + 1 equal entries.
    columns = 50 * torch.ones(5, 40).tril()
    output = output_of_matrix(clouds, columns, 1.0)

    percent = SET_METRICS["matrix/nonzero_percent"].measure(clouds, output, (5, 2))

    assert percent is not None
    of_five = 100 * (1 + 2 + 3 + 4 + 5) / 5 / 40
    of_two = 100 * (1 + 2) / 2 / 40
    assert percent[5].tolist() == pytest.approx([of_five, of_five, of_five])
    assert percent[2].tolist() == pytest.approx([of_two, of_two, of_two])


def test_set_metric_of_nan_is_nan():
    for metric in SET_METRICS.values():
        mean = metric()
        mean.update(torch.tensor([1.0, float("nan")]))
        assert mean.compute().isnan()


def test_matrix_metrics_without_matrix_are_none(clouds):
    output = generated(clouds[:, :5])
    assert values("matrix/nonzero_percent", clouds, output) is None
    assert values("matrix/orthogonality_error", clouds, output) is None
