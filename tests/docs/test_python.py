"""Examples of docs/python.md, run as written."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch

import mops_lightning

DOCS = Path(__file__).parents[2] / "docs"


def example(title):
    """Return the first Python block below a title."""
    page = (DOCS / "python.md").read_text()
    text = re.search(rf"#+ {title}\n.*?```python\n(.*?)```", page, flags=re.S)
    assert text is not None
    return text[1]


def test_labels_come_back_to_all_points():
    names: dict[str, Any] = {}
    exec(example("Back to all points"), names)
    labels, points = names["labels"], names["points"]
    assert (labels.shape, labels.dtype) == ((4096,), torch.bool)
    assert ((points[:, 0] > 0.5) == labels).float().mean() > 0.9


def test_node_attributes_follow_in_pytorch_geometric():
    data = pytest.importorskip("torch_geometric.data").Data(pos=torch.rand(300, 3))
    data.row = torch.arange(300)
    names: dict[str, Any] = {"data": data, "mops_lightning": mops_lightning}
    exec(example("PyTorch Geometric"), names)
    assert torch.equal(data.pos[names["data"].row], names["data"].pos)
    assert len(names["data"].pos) == 100


def test_pointnet2_layer_runs_with_one_import_replaced():
    pytest.importorskip("torch_geometric", reason="torch_geometric is in the extra test")
    names: dict[str, Any] = {}
    exec(example("Farthest points"), names)
    assert names["x"].shape == (768, 64)
    assert names["batch"].bincount().tolist() == [256] * 3
    names["x"].sum().backward()
