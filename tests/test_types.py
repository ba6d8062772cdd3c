"""Types that data, samplers and tasks exchange."""

import torch

from mops_lightning.seeding import derive_seed, generator
from mops_lightning.tree import dotted
from mops_lightning.types import Batch, PairBatch, SampleOutput


def test_first_points_of_a_sample_keep_all_that_belongs_to_them(rng):
    rows = torch.arange(10).expand(2, 10)
    output = SampleOutput(
        torch.rand(2, 10, 3, generator=rng),
        rows,
        {"subset": torch.tensor(1.0)},
        soft_projected=torch.rand(2, 10, 3, generator=rng),
        log_residuals=torch.rand(2, 50, generator=rng),
        neighbours=torch.rand(2, 10, 4, generator=rng),
    )

    first = output.first(4)

    assert torch.equal(first.points, output.points[:, :4])
    assert first.indices is not None
    assert torch.equal(first.indices, rows[:, :4])
    assert first.losses == {}
    assert first.soft_projected is not None
    assert output.soft_projected is not None
    assert torch.equal(first.soft_projected, output.soft_projected[:, :4])
    assert first.log_residuals is output.log_residuals  # of the cloud
    assert first.neighbours is not None
    assert output.neighbours is not None
    assert torch.equal(first.neighbours, output.neighbours[:, :4])
    whole = output.first(10)
    assert whole.losses == {}
    assert whole.points is output.points
    assert SampleOutput(output.points, None, {}).first(4).indices is None


def test_batches_count_clouds_and_pairs():
    clouds = torch.zeros(6, 5, 3)

    assert Batch(clouds, torch.zeros(6)).num_clouds == 6
    pairs = PairBatch(clouds, torch.zeros(6, 3), torch.zeros(3, 4), torch.zeros(3, 3))
    assert pairs.num_clouds == 3


def test_derived_seeds_depend_on_every_number_and_their_order():
    numbers = [(0,), (1,), (0, 1), (1, 2), (2, 1), (1, 2, 3)]

    seeds = [derive_seed(*several) for several in numbers]

    assert len(set(seeds)) == len(numbers)
    assert all(2**32 < seed < 2**63 for seed in seeds)
    # They stay, so that old runs can be repeated.
    assert derive_seed(0) == 7896617691693857887
    drawn = torch.rand(3, generator=generator(1, 2))
    assert torch.equal(drawn, torch.rand(3, generator=generator(1, 2)))
    assert not torch.equal(drawn, torch.rand(3, generator=generator(2, 1)))


def test_dotted_settings_are_leaves_and_lists():
    tree = {"a": {"b": 1, "c": {"d": [1, {"e": 2}]}, "f": {}}, 3: None}

    assert dotted(tree) == {"a.b": 1, "a.c.d": [1, {"e": 2}], "3": None}
    assert dotted(tree["a"], "x") == {"x.b": 1, "x.c.d": [1, {"e": 2}]}
    assert dotted(5, "x") == {"x": 5}
