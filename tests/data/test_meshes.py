import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from mops_lightning.data.meshes import meshes
from mops_lightning.errors import UserError

BOX = trimesh.creation.box((1.0, 2.0, 3.0))
BALL = trimesh.creation.icosphere(subdivisions=1)


def write(path: Path, mesh: Any, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path, **options)
    return path


def scaled(mesh: trimesh.Trimesh, factor: float) -> trimesh.Trimesh:
    return mesh.copy().apply_scale(factor).apply_translation((7, 8, 9))


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    """ModelNet's layout: two classes, three training and two test meshes."""
    root = tmp_path / "set"
    for name, mesh in (("box", BOX), ("ball", BALL)):
        write(root / name / "train" / f"{name}_1.off", scaled(mesh, 10))
        write(root / name / "test" / f"{name}_3.OFF", scaled(mesh, 2), file_type="off")
    write(root / "box" / "train" / "box_2.ply", BOX)
    (root / "box" / "readme.txt").write_text("not a mesh")
    return root


def test_meshes_reads_modelnet_layout(layout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = meshes(layout, n_points=200)
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


def test_meshes_class_in_one_split_is_reported(
    layout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (layout / "ball" / "test" / "ball_3.OFF").unlink()
    dataset = meshes(layout, n_points=20)
    assert dataset.notes["classes_without_test_meshes"] == ["ball"]
    assert "no test mesh of ball: never scored" in capsys.readouterr().err


def test_meshes_broken_mesh_raises_or_is_skipped(layout: Path) -> None:
    whole = meshes(layout, n_points=20)
    (layout / "ball" / "train" / "a.off").write_bytes(b"OFF\n")
    (layout / "box" / "test" / "b.stl").write_bytes(b"")
    with pytest.raises(UserError, match=r"a\.off is broken.*dataset\.skip_broken=true"):
        meshes(layout, n_points=20)
    dataset = meshes(layout, n_points=20, skip_broken=True)
    assert dataset.notes == {"skipped_meshes": 2}
    assert torch.equal(dataset.train.points, whole.train.points)
    assert torch.equal(dataset.test.labels, whole.test.labels)


def test_meshes_split_without_mesh_raises(layout: Path) -> None:
    for path in layout.glob("*/test/*"):
        path.write_bytes(b"")
    with pytest.raises(UserError, match=r"no test mesh of ball, box .*2 broken meshes"):
        meshes(layout, n_points=20, skip_broken=True)


def test_meshes_cloud_depends_on_content_and_seed(layout: Path, tmp_path: Path) -> None:
    before = repr(np.random.get_state())  # noqa: NPY002
    first = meshes(layout, n_points=50)
    assert repr(np.random.get_state()) == before  # noqa: NPY002
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(layout, elsewhere)
    write(elsewhere / "ball" / "train" / "ball_0.off", BALL)
    again = meshes(elsewhere, n_points=50)
    assert torch.equal(again.train.points[1:], first.train.points)
    other = meshes(layout, n_points=50, seed=1)
    assert not torch.isclose(other.train.points, first.train.points).all(-1).any()
    # Files with the same shape at different scales have different samples.
    assert not torch.allclose(first.train.points[1], first.train.points[2], atol=1e-3)


def test_meshes_fingerprint_depends_on_content_names_and_arguments(
    layout: Path, tmp_path: Path
) -> None:
    first = meshes(layout, n_points=20).fingerprint
    elsewhere = shutil.copytree(layout, tmp_path / "elsewhere")
    assert meshes(elsewhere, n_points=20, cache=tmp_path / "cache").fingerprint == first
    prints = {
        first,
        meshes(layout, n_points=21).fingerprint,
        meshes(layout, n_points=20, seed=1).fingerprint,
        meshes(layout, n_points=20, classes=["box"]).fingerprint,
    }
    (elsewhere / "box" / "train" / "box_1.off").rename(elsewhere / "box" / "train" / "new.off")
    prints.add(meshes(elsewhere, n_points=20).fingerprint)
    write(elsewhere / "box" / "train" / "new.off", BALL)
    prints.add(meshes(elsewhere, n_points=20).fingerprint)
    assert len(prints) == 6


def test_meshes_cache_depends_on_content_and_arguments(layout: Path, tmp_path: Path) -> None:
    cache = tmp_path / "new" / "cache"
    first = meshes(layout, n_points=20, cache=cache)
    kept = sorted(cache.iterdir())
    assert [path.suffix for path in kept] == [".npy"] * 5
    for path in kept:  # the result comes from the cache
        np.save(path, np.load(path) + np.float32(1))
    shutil.move(layout, tmp_path / "moved")
    again = meshes(tmp_path / "moved", n_points=20, cache=str(cache))
    assert torch.equal(again.train.points, first.train.points + 1)
    assert again.fingerprint == first.fingerprint
    meshes(tmp_path / "moved", n_points=21, cache=cache)
    meshes(tmp_path / "moved", n_points=20, cache=cache, seed=1)
    write(tmp_path / "moved" / "box" / "train" / "box_1.off", BALL)
    changed = meshes(tmp_path / "moved", n_points=20, cache=cache)
    assert len(list(cache.iterdir())) == 16
    assert changed.train.points[1].norm(dim=1).max() < 1.001


@pytest.mark.parametrize("damage", [b"", b"\x93NUMPY\x01\x00", b"noise" * 100])
def test_meshes_damaged_cache_is_replaced(layout: Path, tmp_path: Path, damage: bytes) -> None:
    first = meshes(layout, n_points=20, cache=tmp_path / "cache")
    kept = {path: path.read_bytes() for path in (tmp_path / "cache").iterdir()}
    for path in kept:
        path.write_bytes(damage)
    again = meshes(layout, n_points=20, cache=tmp_path / "cache")
    assert torch.equal(again.train.points, first.train.points)
    assert {path: path.read_bytes() for path in kept} == kept


def test_meshes_unwritable_cache_raises(layout: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"^cache: cannot write"):
        meshes(layout, n_points=20, cache=tmp_path / "file", skip_broken=True)


def test_meshes_workers_give_same_result(layout: Path) -> None:
    (layout / "ball" / "train" / "a.off").write_bytes(b"OFF\n")
    one = meshes(layout, n_points=20, skip_broken=True)
    two = meshes(layout, n_points=20, skip_broken=True, workers=2)
    assert torch.equal(one.train.points, two.train.points)
    assert torch.equal(one.test.points, two.test.points)
    assert one.fingerprint == two.fingerprint
    assert one.notes == two.notes == {"skipped_meshes": 1}


def test_meshes_selects_classes(layout: Path) -> None:
    dataset = meshes(layout, n_points=20, classes=["box"])
    assert dataset.class_names == ("box",)
    assert dataset.train.labels.tolist() == [0, 0]
    with pytest.raises(UserError, match=r"'bix'.*Did you mean 'box'"):
        meshes(layout, classes=["bix"])


@pytest.fixture
def flat(tmp_path: Path) -> Path:
    root = tmp_path / "flat"
    for name in ("box/1.off", "box/2.off", "ball/old, round/3.off", "ball/4.off", "ball/5.off"):
        write(root / name, BOX if name.startswith("box") else BALL)
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
    with pytest.raises(UserError, match="lists no mesh"):
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
def test_meshes_argument_out_of_range_raises(layout: Path, argument: dict[str, Any]) -> None:
    name = next(iter(argument))
    with pytest.raises(UserError, match=rf"^{name} must be at least"):
        meshes(layout, **argument)


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
