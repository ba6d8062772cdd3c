import re

import pytest
import torch

from mops_lightning import load
from mops_lightning.cli.models import export
from tests.support.captured import captured, refused
from tests.support.full_disk import full_disk


def test_export_of_a_model_writes_a_file_that_runs_at_any_size(tmp_path):
    target = tmp_path / "net.pt2"
    command = "mops-lightning export"
    model = "fmops.modelnet40-m512"
    status, out, err = captured(export, [model, target, "--m", 10], command)
    assert (status, err) == (0, "")
    said = rf"{target}: (.+) MB; largest difference from the sampler \d\.\de-\d\d\n"
    printed = re.fullmatch(said, out)
    assert printed is not None
    assert printed[1] == f"{target.stat().st_size / 1e6:.2f}"
    net, sampler = torch.export.load(target).module(), load(model)
    with torch.no_grad():
        for shape in ((1, 12), (4, 100), (2, 257)):
            points = torch.rand(*shape, 3)
            assert torch.allclose(net(points), sampler(points, 10).points, atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["mops.modelnet", "net.onnx"], "Did you mean 'mops.modelnet40-m32'"),
        (["pointnet.modelnet40", "net.onnx"], "holds a task net"),
        (["mops.modelnet40-m32", "net.txt"], "OUT must end in .onnx or .pt2"),
        (["mops.modelnet40-m32", "net.onnx", "--m", 31], "m must be 32"),
        (["mops.modelnet40-m32", "old.onnx"], "old.onnx exists"),
    ],
)
def test_export_mistakes_are_one_line(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old.onnx").touch()
    err = refused(export, arguments, "mops-lightning export")
    assert err.startswith("mops-lightning export: ")
    assert words in err
    assert [path.name for path in tmp_path.iterdir()] == ["old.onnx"]


def test_export_on_a_full_disk_is_one_line(tmp_path):
    target = tmp_path / "net.pt2"
    with full_disk():
        err = refused(export, ["mops.modelnet40-m32", target], "mops-lightning export")
    assert f"{target}: File too large. Free some space" in err
    assert not list(tmp_path.iterdir())


def test_export_replaces_a_file_on_request(tmp_path):
    target = tmp_path / "net.pt2"
    target.write_text("old")

    status, out, err = captured(export, ["snet.modelnet40-m32", target, "--overwrite"], "export")

    assert (status, err) == (0, "")
    assert target.read_bytes()[:2] == b"PK"
