import pytest
import torch

from mops_lightning.ops.facility_location import SHORTLIST, facility_location


def plain_greedy(features, m):
    """One cloud: every gain in every step."""
    chosen: list[int] = []
    covered = torch.zeros(features.shape[1], dtype=features.dtype)
    while len(chosen) < m:
        gains = (features - covered).clamp(min=0).sum(1)
        gains[chosen] = -1
        best = int(gains.argmax())
        if chosen and gains[best] <= 0:
            break
        chosen.append(best)
        covered = torch.maximum(covered, features[best])
    return chosen


@pytest.mark.parametrize("points", [SHORTLIST - 3, 4 * SHORTLIST])
@pytest.mark.parametrize("channels", [3, 40])
def test_facility_location_equals_plain_greedy(points, channels, rng):
    features = torch.randn(5, points, channels, dtype=torch.float64, generator=rng).relu()
    features[1, points // 2 :] = features[1, : points - points // 2].clone()  # ties
    chosen, given = facility_location(features, points - 1)
    for cloud, row, number in zip(features, chosen, given, strict=True):
        want = plain_greedy(cloud, points - 1)
        assert torch.equal(cloud[row[:number]], cloud[want])
        assert len(set(row[:number].tolist())) == number
    assert given.min() < points - 1 or channels > 3


def test_facility_location_is_nested(rng):
    features = torch.rand(2, 50, 30, generator=rng)
    assert torch.equal(facility_location(features, 4)[0], facility_location(features, 9)[0][:, :4])


def test_facility_location_of_one_point():
    with torch.device("meta"):  # the default device is not used
        chosen, given = facility_location(torch.ones(2, 1, 6, device="cpu"), 1)
    assert chosen.tolist() == [[0], [0]]
    assert given.tolist() == [1, 1]


def test_facility_location_without_gain_chooses_one():
    chosen, given = facility_location(torch.zeros(2, 40, 6), 5)
    assert chosen.shape == (2, 5)
    assert given.tolist() == [1, 1]
