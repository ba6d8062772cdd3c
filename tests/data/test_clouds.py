from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.clouds import (
    CloudDataset,
    Clouds,
    check_parts,
    choose_classes,
    make_dataset,
    noisy,
    scale_warning,
)
from mops_lightning.errors import UserError
from mops_lightning.seeding import generator

KNOWN = ("chair", "lamp", "table")


@pytest.mark.parametrize(
    ("classes", "chosen"),
    [
        (None, KNOWN),
        ([], KNOWN),
        (["table", "chair"], ("chair", "table")),
    ],
)
def test_choose_classes_keeps_order_of_dataset(classes, chosen):
    assert choose_classes(classes, KNOWN) == chosen


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ("chair", r"^classes must be a list of names, such as \[chair\], got 'chair'"),
        (["chiar"], r"^classes: unknown class 'chiar'.*chair"),
        ([3], r"^classes must be a list of names"),
        (7, r"^classes must be a list of names"),
    ],
)
def test_choose_classes_invalid_raises(classes, message):
    with pytest.raises(UserError, match=message):
        choose_classes(classes, KNOWN)


def split_of(points):
    labels = torch.zeros(len(points), dtype=torch.int64)
    return Clouds(points, labels)


def test_noisy_has_standard_deviation(rng):
    points = torch.randn(20, 2000, 3, generator=rng)

    added = noisy(split_of(points), 0.05).points - points

    spreads = added.std((0, 1)).tolist()
    means = added.mean((0, 1))
    assert spreads == pytest.approx([0.05] * 3, rel=0.02)
    assert means.abs().max() < 0.001
    assert added.abs().max() > 0.2  # not clipped at four standard deviations


def test_noisy_depends_on_position_and_scales(rng):
    points = torch.randn(5, 30, 3, generator=rng)
    whole = split_of(points)
    beginning = split_of(points[:3])

    small = noisy(whole, 0.01).points - points
    large = noisy(whole, 0.1).points - points
    large_of_beginning = noisy(beginning, 0.1).points - points[:3]
    without = noisy(whole, 0.0)

    assert_close(large[:3], large_of_beginning)
    assert_close(10 * small, large, atol=1e-5, rtol=1e-4)
    assert not torch.equal(small[0], small[1])
    assert torch.equal(without.points, points)


def test_noisy_draws_the_published_noise_and_keeps_channels():
    """Committed figures of noise were measured with these numbers."""
    points = torch.rand(2, 5, 4)

    moved = noisy(split_of(points), 0.1).points

    for number in range(2):
        drawn = torch.randn(5, 3, generator=generator(13, number))
        expected = points[number, :, :3] + 0.1 * drawn
        assert_close(moved[number, :, :3], expected)
    assert torch.equal(moved[..., 3], points[..., 3])


def spheres(radii):
    """Return clouds of 30 points, each at a distance from the origin."""
    directions = torch.randn(len(radii), 30, 3, generator=torch.Generator().manual_seed(0))
    unit = torch.nn.functional.normalize(directions, dim=2)
    return split_of(unit * torch.tensor(radii)[:, None, None])


@pytest.mark.parametrize("radius", [0.01, 0.45, 2.1, 100])
def test_scale_warning_names_the_radius(radius):
    clouds = spheres([radius] * 5)
    dataset = CloudDataset(("a",), clouds, clouds, "")

    warning = scale_warning(dataset)

    assert f"about {radius:g} from the origin" in str(warning)


@pytest.mark.parametrize("radii", [[1.0] * 5, [0.55] * 5, [1.9] * 5, [1.0, 1.0, 500.0]])
def test_scale_warning_is_not_given_for_about_the_unit_sphere(radii):
    clouds = spheres(radii)
    dataset = CloudDataset(("a",), clouds, clouds, "")

    assert scale_warning(dataset) is None


def labelled(parts, names=("0", "1", "2")):
    """Return a data set of one training and one test cloud with parts."""
    splits = []
    for parts_of_cloud in parts:
        cloud = split_of(torch.rand(1, 4, 3))
        splits.append(cloud._replace(parts=torch.tensor([parts_of_cloud])))
    train, test = splits
    return CloudDataset(("a",), train, test, "", part_names=names)


def test_check_parts_says_which_parts_a_split_lacks(capsys):
    check_parts(labelled([[0, 1, 2, 2], [0, -1, -1, 0]]))

    assert capsys.readouterr().err == "dataset: no test point of part 1, 2.\n"


@pytest.mark.parametrize(
    ("parts", "split"),
    [
        ([[-1, -1, -1, -1], [0, 1, 2, 2]], "training"),
        ([[0, 1, 2, 2], [-1, -1, -1, -1]], "test"),
    ],
)
def test_check_parts_refuses_a_split_without_known_parts(parts, split):
    with pytest.raises(UserError, match=f"no {split} point has a known part"):
        check_parts(labelled(parts))


@pytest.mark.parametrize(
    ("names", "found"),
    [
        ((), "got none"),
        (("7",), "got only part 7"),
        (tuple(str(number) for number in range(1001)), "got 1001"),
    ],
    ids=["none", "one", "too many"],
)
def test_check_parts_refuses_numbers_that_are_no_parts(names, found):
    dataset = labelled([[0, 0, 0, 0], [0, 0, 0, 0]], names)

    with pytest.raises(UserError, match=rf"must belong to 2 to 1000 parts, {found}\."):
        check_parts(dataset)


def test_check_parts_allows_a_thousand_parts():
    names = tuple(str(number) for number in range(1000))

    check_parts(labelled([[0, 1, 2, 3], [0, 1, 2, 3]], names))


def test_smallest_and_rows_of_clouds_of_different_sizes():
    clouds = Clouds(
        torch.rand(3, 9, 3),
        torch.arange(3),
        sources=torch.tensor([4, 4, 5]),
        parts=torch.arange(27).view(3, 9),
        sizes=torch.tensor([9, 6, 8]),
    )

    taken = clouds.take(torch.tensor([2, 1]))

    assert clouds.smallest == (1, 6)
    assert taken.smallest == (1, 6)
    assert clouds._replace(sizes=None).smallest == (0, 9)
    assert taken.sources is not None
    assert taken.parts is not None
    assert taken.sizes is not None
    assert taken.sources.tolist() == [5, 4]
    assert taken.parts[:, 0].tolist() == [18, 9]
    assert taken.sizes.tolist() == [8, 6]


FOLDER = Path("folder")


def made(**changes):
    """Return the fingerprint of a data set of two classes, in which something is different."""
    split = Clouds(
        torch.arange(24.0).view(2, 4, 3),
        torch.tensor([0, 1]),
        parts=torch.zeros(2, 4, dtype=torch.long),
        sizes=torch.tensor([4, 3]),
    )
    arguments: dict[str, Any] = {
        "kind": "kind",
        "known": ("a", "b"),
        "classes": None,
        "files": {"train": ["1"], "test": ["2"]},
        "channels": PointChannels([Channel("c", 1.0, 2.0)]),
    }
    test = split
    for name, value in changes.items():
        if name in arguments:
            arguments[name] = value
        else:
            test = test._replace(**{name: value})
    return make_dataset(splits={"train": split, "test": test}, folder=FOLDER, **arguments)


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "other"},
        {"known": ("a", "c")},
        {"classes": ["a"]},
        {"files": {"train": ["1"], "test": ["3"]}},
        {"files": None},
        {"channels": PointChannels([Channel("c", 1.0, 3.0)])},
        {"points": torch.zeros(2, 4, 3)},
        {"labels": torch.tensor([1, 0])},
        {"parts": torch.ones(2, 4, dtype=torch.long)},
        {"sizes": torch.tensor([4, 2])},
    ],
    ids=lambda change: next(iter(change)),
)
def test_fingerprint_changes_with_all_that_a_data_set_is(change):
    same = made()
    other = made(**change)

    assert made().fingerprint == same.fingerprint
    assert other.fingerprint != same.fingerprint
