"""The examples of docs/own_network.md, run as written."""

import re
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import cross_entropy

from mops_lightning import MOPSNet

PAGE = (Path(__file__).parents[2] / "docs" / "own_network.md").read_text()
SCRIPTS = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE, flags=re.S))

MY_NET = """\
import torch
from torch import nn

class Net(nn.Module):
    def forward(self, points):  # how far the points are spread along x, against y
        spread = points.std(dim=1)
        return 20 * (spread[:, :2] - spread[:, :2].mean(1, keepdim=True))

net = Net()
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A user's folder: long boxes along x or y, and a net that tells them apart."""
    random = np.random.default_rng(0)
    labels = np.arange(64) % 2
    points = random.random((64, 32, 3), dtype=np.float32) - 0.5
    points[labels == 0, :, 1] *= 0.5
    points[labels == 1, :, 0] *= 0.5
    np.savez(tmp_path / "clouds.npz", points=points, labels=labels)
    (tmp_path / "my_net.py").write_text(MY_NET)
    for name, text in SCRIPTS.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("my_net", None)


def test_plain_loop_trains_a_sampler_for_the_net(folder):
    runpy.run_path("plain_loop.py", run_name="__main__")
    data = np.load(folder / "clouds.npz")
    points, labels = torch.from_numpy(data["points"]), torch.from_numpy(data["labels"])
    own: dict[str, Any] = {}
    exec(MY_NET, own)
    torch.manual_seed(0)
    losses = []
    for trained in (False, True):
        sampler = MOPSNet(m=16)
        if trained:
            sampler.load_state_dict(torch.load(folder / "sampler.pt", weights_only=True))
        sample = sampler.eval()(points).points
        losses.append(float(cross_entropy(own["net"](sample.detach()), labels)))
    assert losses[1] < losses[0] / 5


# Lightning's hints to users: there are no validation clouds, and few batches.
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.usefixtures("folder")
def test_lightning_scores_every_readout(capsys):
    runpy.run_path("by_lightning.py", run_name="__main__")
    out = capsys.readouterr().out
    for readout in ("generated", "matched", "completed", "fps", "full"):
        assert f"test/{readout}/accuracy" in out
