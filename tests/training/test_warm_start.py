"""A run whose sampler starts from the task net or from another run's sampler."""

import json

import torch

from mops_lightning.training.warm_start import described
from mops_lightning.zoo import weights
from tests.support.command_line import TINY, call


def run(tmp_path, name, *overrides):
    settings = [*TINY, "weights=null", "recipe.ema_span=null", f"hydra.run.dir={tmp_path / name}"]
    return call([*settings, *overrides], tmp_path)


def test_sampler_of_another_size_continues_from_a_run(tmp_path):
    status, out, err = run(tmp_path, "first", "sampler=mops", "m=8")
    assert (status, err) == (0, "")
    assert "Warm start: the first" in out
    first = tmp_path / "first" / "weights.pt"
    still = "optimizer.lr=1e-12"
    folder = first.parent
    status, out, _ = run(tmp_path, "second", "m=5", f"recipe.warm_start={folder}", still)
    assert status == 0
    assert f"tensors are copies of {folder}." in out
    one, two = (weights.read(tmp_path / name / "weights.pt") for name in ("first", "second"))
    rows = two["state"]["queries.weight"]
    torch.testing.assert_close(rows, one["state"]["queries.weight"][:5])
    record = json.loads((tmp_path / "second" / "result.json").read_text())
    assert record["warm_start"]["sha256"] == one["sha256"]
    status, _, err = run(tmp_path, "third", "sampler=snet", f"recipe.warm_start={first}")
    assert status != 0
    assert "recipe.warm_start: no tensor of" in err
    status, _, err = run(tmp_path, "fourth", f"recipe.warm_start={tmp_path / 'nothing.pt'}")
    assert status != 0
    assert "recipe.warm_start: no file" in err


def test_described_names_tensors_that_are_not_copied():
    assert described(["a"], ["a"], "FILE") == "1 of 1 tensors are copies of FILE"
    assert described(["a"], ["a", "b"], "FILE").endswith("copies of FILE; not copied: b")
    assert described(["a"], list("abcde"), "FILE").endswith("not copied: b, c, d, ...")
