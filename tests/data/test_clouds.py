import pytest
import torch
from torch.testing import assert_close

from mops_lightning.data.clouds import CloudDataset, Clouds, choose_classes, noisy, scale_warning
from mops_lightning.errors import UserError

KNOWN = ("chair", "lamp", "table")


@pytest.mark.parametrize(
    ("classes", "chosen"), [(None, KNOWN), ([], KNOWN), (["table", "chair"], ("chair", "table"))]
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
    return Clouds(points, torch.zeros(len(points), dtype=torch.int64))


def test_noisy_has_standard_deviation(rng):
    points = torch.randn(20, 2000, 3, generator=rng)
    added = noisy(split_of(points), 0.05).points - points
    assert added.std((0, 1)).tolist() == pytest.approx([0.05] * 3, rel=0.02)
    assert added.mean((0, 1)).abs().max() < 0.001
    assert added.abs().max() > 0.2  # not clipped at four standard deviations


def test_noisy_depends_on_position_and_scales(rng):
    points = torch.randn(5, 30, 3, generator=rng)
    small, large = (noisy(split_of(points), noise).points - points for noise in (0.01, 0.1))
    first = noisy(split_of(points[:3]), 0.1).points - points[:3]
    assert_close(large[:3], first)
    assert_close(10 * small, large, atol=1e-5, rtol=1e-4)
    assert not torch.equal(small[0], small[1])
    assert torch.equal(noisy(split_of(points), 0.0).points, points)


@pytest.mark.parametrize(("scale", "warned"), [(1, False), (0.01, True), (100, True)])
def test_scale_warning_names_the_radius(scale, warned, rng):
    points = torch.nn.functional.normalize(torch.randn(5, 30, 3, generator=rng), dim=2)
    clouds = split_of(points * scale)
    warning = scale_warning(CloudDataset(("a",), clouds, clouds, ""))
    assert (warning is not None) == warned
    assert not warned or f"about {scale:g} from the origin" in str(warning)
