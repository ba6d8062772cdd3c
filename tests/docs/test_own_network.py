"""The examples of docs/extend.md for an own network: what they train, and what they score."""

import re
import runpy
import sys
from pathlib import Path

import pytest
import torch
from torch.nn.functional import cross_entropy

from mops_lightning import MOPSNet

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extend.md").read_text()
INCLUDED = re.findall(r'``` \{\.python\}\n--8<-- "(.*)"\n```', PAGE)


def test_page_includes_two_examples_and_links_to_them():
    assert INCLUDED == ["examples/03_own_network.py", "examples/04_own_sampler.py"]
    for name in INCLUDED:
        assert f"[{name}](../{name})" in PAGE


@pytest.fixture
def run_example(tmp_path, monkeypatch):
    """Run an example in a folder of its own, and return the names that it defines."""
    monkeypatch.chdir(tmp_path)

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        return runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")

    return run


def test_plain_loop_trains_a_sampler_for_the_net(run_example):
    names = run_example("03_own_network.py", "100")
    net = names["net"]
    torch.manual_seed(1)
    points, labels = names["boxes"](200)
    untrained = MOPSNet(m=8).eval()

    with torch.no_grad():
        before = cross_entropy(net(untrained(points).points), labels)
        after = cross_entropy(net(names["sampler"](points).points), labels)

    assert after < before / 5


# Lightning's hints to users: there are no validation clouds, and few batches.
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_lightning_scores_every_readout(run_example):
    scores = run_example("04_own_sampler.py", "--epochs", "1")["scores"]

    for readout in ("generated", "matched", "completed", "fps", "full"):
        assert 0 <= scores[f"test/{readout}/accuracy"] <= 1
