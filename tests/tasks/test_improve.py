import pytest
import torch

from mops_lightning.tasks import refinement as module
from mops_lightning.tasks.refinement import estimated_changes, improve


def distance(wanted):
    """An objective that is not linear: the squared distance of a mixture of the channels."""
    mixture = torch.randn(wanted.shape[1], 4, dtype=wanted.dtype).softmax(0)

    def objective(pooled, cloud):
        return ((pooled - wanted[cloud]) @ mixture).tanh().square().sum(1)

    return objective


def plain_improve(features, indices, objective, passes):
    """One cloud: every row at every place, scored exactly."""
    rows = list(indices)
    cloud = torch.zeros(1, dtype=torch.int64)

    def score(chosen):
        return float(objective(features[chosen].amax(0, keepdim=True), cloud))

    for _ in range(passes):
        for place in range(len(rows)):
            others = [row for row in range(len(features)) if row not in rows]
            options = [[*rows[:place], row, *rows[place + 1 :]] for row in others]
            best = min(options, key=score)
            if score(best) < score(rows) - max(module.MIN_GAIN * score(rows), module.ROUNDING):
                rows = best
    return rows


@pytest.mark.parametrize("m", [1, 5])
def test_refine_with_full_shortlist_equals_exhaustive_exchange(m, rng, monkeypatch):
    monkeypatch.setattr(module, "SHORTLIST", 30)
    features = torch.randn(3, 30, 12, dtype=torch.float64, generator=rng).relu()
    indices = torch.stack([torch.randperm(30, generator=rng)[:m] for _ in range(3)])
    objective = distance(features.amax(1))
    found = improve(features, indices, objective, 3)
    for number, got in enumerate(found.tolist()):
        alone = features[number]

        def one(pooled, cloud, number=number):
            return objective(pooled, cloud + number)

        assert got == plain_improve(alone, indices[number].tolist(), one, 3)


def test_refine_exchanges_nothing_for_rounding_errors_or_without_other_points(rng):
    features = torch.rand(2, 30, 8, generator=rng)
    few, every = (torch.arange(number).expand(2, -1) for number in (20, 30))
    assert torch.equal(improve(features, few, lambda p, _: 1e-10 * p.mean(1), 2), few)
    assert not torch.equal(improve(features, few, lambda p, _: p.mean(1), 2), few)
    assert torch.equal(improve(features, every, lambda p, _: p.mean(1), 2), every)


def test_refine_lowers_objective_and_keeps_rows_distinct(rng):
    features = torch.randn(6, 80, 20, generator=rng).relu()
    indices = torch.stack([torch.randperm(80, generator=rng)[:9] for _ in range(6)])
    objective = distance(features.amax(1))

    def scores(rows):
        pooled = features.gather(1, rows[..., None].expand(-1, -1, 20)).amax(1)
        return objective(pooled, torch.arange(6))

    values = [scores(improve(features, indices, objective, passes)) for passes in (0, 1, 4)]
    assert (values[1] < values[0]).all()
    assert (values[2] <= values[1]).all()
    rows = improve(features, indices, objective, 4)
    assert all(len(set(row)) == 9 for row in rows.tolist())
    one_cloud = improve(features[:1], indices[:1], objective, 4)
    assert torch.equal(one_cloud, rows[:1])


def test_estimated_changes_equal_plain_sums(rng):
    features = torch.randn(20, 7, dtype=torch.float64, generator=rng).relu()
    gradient = torch.randn(7, dtype=torch.float64, generator=rng)
    rows = [3, 11, 5]
    chosen = features[rows]
    got = estimated_changes(features, chosen, gradient)
    for place in range(3):
        rest = chosen[[other for other in range(3) if other != place]].amax(0)
        want = (torch.maximum(features, rest) - chosen.amax(0)) @ gradient
        torch.testing.assert_close(got[place], want)
