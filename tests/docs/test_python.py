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

    labels = names["labels"]
    assert labels.shape == (4096,)
    assert labels.dtype == torch.bool
    expected = names["points"][:, 0] > 0.5
    is_right = labels == expected
    assert is_right.float().mean() > 0.9


def test_node_attributes_follow_in_pytorch_geometric():
    graphs = pytest.importorskip("torch_geometric.data")
    data = graphs.Data(pos=torch.rand(300, 3))
    data.row = torch.arange(300)
    names: dict[str, Any] = {"data": data, "mops_lightning": mops_lightning}

    exec(example("PyTorch Geometric"), names)

    sampled = names["data"]
    assert torch.equal(data.pos[sampled.row], sampled.pos)
    assert len(sampled.pos) == 100


def test_pointnet2_layer_runs_with_one_import_replaced():
    pytest.importorskip("torch_geometric", reason="torch_geometric is in the extra test")
    names: dict[str, Any] = {}

    exec(example("Farthest points"), names)

    features = names["x"]
    assert features.shape == (768, 64)
    points_of_clouds = names["batch"].bincount()
    assert points_of_clouds.tolist() == [256] * 3
    features.sum().backward()
