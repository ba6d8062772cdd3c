import pytest
import torch

from mops_lightning.ops.argextreme import GROUP, blocked_argextreme


@pytest.mark.usefixtures("argextreme_path")
@pytest.mark.parametrize("largest", [True, False])
def test_argextreme_of_ties_is_lowest_position(largest, rng):
    values = torch.randint(0, 9, (50, 3 * GROUP), generator=rng).float()
    rows = values.tolist()
    expected = [row.index(max(row) if largest else min(row)) for row in rows]
    assert blocked_argextreme(values, largest).squeeze(1).tolist() == expected
