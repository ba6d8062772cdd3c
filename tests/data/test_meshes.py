import os
from pathlib import Path
from typing import Any

import pytest
import torch

from mops_lightning.data.meshes import meshes
from mops_lightning.errors import UserError
from tests.support.meshes import BALL, BOX, write_mesh


def test_meshes_reads_modelnet_layout(
    mesh_layout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = meshes(mesh_layout, n_points=200)
    assert dataset.class_names == ("ball", "box")
    assert dataset.train.labels.tolist() == [0, 1, 1]
    assert dataset.test.labels.tolist() == [0, 1]
    assert dataset.notes == {"skipped_meshes": 0}
    for clouds in (dataset.train, dataset.test):
        assert clouds.points.shape == (len(clouds.labels), 200, 3)
        assert (clouds.points.dtype, clouds.labels.dtype) == (torch.float32, torch.int64)
        torch.testing.assert_close(clouds.points.mean(1), torch.zeros(len(clouds.labels), 3))
        farthest = clouds.points.norm(dim=2).amax(1)
        torch.testing.assert_close(farthest, torch.ones(len(clouds.labels)))
    assert capsys.readouterr() == ("", "")  # no progress bar without a terminal


def test_meshes_selects_classes(mesh_layout: Path) -> None:
    dataset = meshes(mesh_layout, n_points=20, classes=["box"])
    assert dataset.class_names == ("box",)
    assert dataset.train.labels.tolist() == [0, 0]
    with pytest.raises(UserError, match=r"'bix'.*Did you mean 'box'"):
        meshes(mesh_layout, classes=["bix"])


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    root = tmp_path / "flat"
    for name in ("box/1.off", "box/2.off", "ball/old, round/3.off", "ball/4.off", "ball/5.off"):
        write_mesh(root / name, BOX if name.startswith("box") else BALL)
    return root


def test_meshes_split_file_assigns_splits(flat: Path) -> None:
    lines = [
        "path,split",
        "# a comment",
        "",
        "box/1.off,train",
        '"ball/old, round/3.off", train',
        " box/2.off , test ",
        "ball/4.off,test",
    ]
    (flat / "split.csv").write_text("\ufeff" + "\n".join(lines), encoding="utf-8")
    dataset = meshes(flat, n_points=20, split_file="split.csv")
    assert dataset.class_names == ("ball", "box")
    assert dataset.train.labels.tolist() == [0, 1]
    assert dataset.test.labels.tolist() == [0, 1]
    same = meshes(flat, n_points=20, split_file=flat / "split.csv")
    assert same.fingerprint == dataset.fingerprint
    (flat / "split.csv").write_text("\n".join([*lines[:5], "box/2.off,train", lines[6]]))
    other = meshes(flat, n_points=20, split_file="split.csv")
    assert other.train.labels.tolist() == [0, 1, 1]
    assert other.fingerprint != dataset.fingerprint


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("box/2.off", "line 2: must read 'path,train' or 'path,test'"),
        ("box/2.off,val", "line 2: must read"),
        ("2.off,train", "line 2: the path must be CLASS/"),
        ("/box/2.off,train", "line 2: the path must be CLASS/"),
        ("box/../box/2.off,train", "line 2: the path must be CLASS/"),
        ("box/2.txt,train", "line 2: box/2.txt must end in"),
        ("box/1.off,test", "line 2: box/1.off is listed twice"),
        ("box/9.off,test", "line 2: .*9.off does not exist"),
    ],
)
def test_meshes_invalid_split_file_line_raises(flat: Path, line: str, message: str) -> None:
    (flat / "split.txt").write_text(f"box/1.off,train\n{line}\n")
    with pytest.raises(UserError, match=rf"^split_file: .*split\.txt, {message}"):
        meshes(flat, split_file="split.txt")


def test_meshes_unusable_split_file_raises(flat: Path) -> None:
    with pytest.raises(UserError, match=r"^split_file: cannot read none\.txt"):
        meshes(flat, split_file="none.txt")
    (flat / "split.txt").write_text("# nothing\n")
    with pytest.raises(UserError, match="lists no file"):
        meshes(flat, split_file="split.txt")
    (flat / "split.txt").write_text("box/1.off,train\n")
    with pytest.raises(UserError, match="no test mesh of box"):
        meshes(flat, split_file="split.txt", n_points=20)


def test_meshes_unusable_folder_raises(flat: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^root: .*none is not a folder"):
        meshes(tmp_path / "none")
    with pytest.raises(UserError, match=r"meshes in CLASS/\*.*dataset\.split_file=FILE"):
        meshes(flat)
    (tmp_path / "nothing").mkdir()
    with pytest.raises(UserError, match=r"^root: no mesh in .*CLASS/train"):
        meshes(tmp_path / "nothing")


@pytest.mark.parametrize("argument", [{"n_points": 0}, {"seed": -1}, {"workers": 0}])
def test_meshes_argument_out_of_range_raises(mesh_layout: Path, argument: dict[str, Any]) -> None:
    name = next(iter(argument))
    with pytest.raises(UserError, match=rf"^{name} must be at least"):
        meshes(mesh_layout, **argument)


@pytest.mark.skipif("MOPS_DATA" not in os.environ, reason="MOPS_DATA names no folder of real data")
def test_meshes_real_data(tmp_path: Path) -> None:
    root = Path(os.environ["MOPS_DATA"]) / "vlasic2008"
    names = [path.relative_to(root).as_posix() for path in sorted(root.glob("*/*.ply"))[::20]]
    lines = [f"{name},{'train' if i % 2 else 'test'}" for i, name in enumerate(names)]
    (tmp_path / "split.csv").write_text("\n".join(lines))
    dataset = meshes(root, n_points=4096, split_file=tmp_path / "split.csv")
    assert set(dataset.class_names) == {name.split("/")[0] for name in names}
    assert len(dataset.train.labels) + len(dataset.test.labels) == len(names)
    assert dataset.train.points.isfinite().all()
