import pytest
import torch

from mops_lightning.data.clouds import Clouds, choose_classes, select_classes
from mops_lightning.errors import UserError

KNOWN = ("chair", "lamp", "table")


@pytest.mark.parametrize(
    ("classes", "chosen"),
    [(None, KNOWN), ([], KNOWN), (["table", "chair"], ("chair", "table"))],
)
def test_choose_classes_keeps_order_of_dataset(classes, chosen):
    assert choose_classes(classes, KNOWN) == chosen


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ("chair", r"^classes must be a list, such as \[chair\], got 'chair'"),
        (["chiar"], r"^classes: unknown class 'chiar'.*chair"),
    ],
)
def test_choose_classes_invalid_raises(classes, message):
    with pytest.raises(UserError, match=message):
        choose_classes(classes, KNOWN)


def test_select_classes_renumbers_labels():
    clouds = Clouds(torch.arange(5.0).view(5, 1, 1).expand(5, 2, 3), torch.tensor([2, 0, 1, 2, 0]))
    selected = select_classes(clouds, KNOWN, ("chair", "table"))
    assert selected.labels.tolist() == [1, 0, 1, 0]
    assert selected.points[:, 0, 0].tolist() == [0, 1, 3, 4]
