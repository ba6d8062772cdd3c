"""The files that git tracks: a small tree, with all weights in one folder."""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from mops_lightning.zoo import weights

ROOT = Path(__file__).parents[1]
TREE = 25_000_000
PICTURE = 300_000
PICTURES = {".png", ".svg", ".jpg", ".jpeg", ".gif", ".webp"}
WEIGHTS = {".pt", ".pth", ".ckpt", ".safetensors", ".onnx"}


@pytest.fixture(scope="module")
def tracked() -> list[Path]:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout")
    command = ["git", "-C", str(ROOT), "ls-files", "-z"]
    listed = subprocess.run(command, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip(f"git ls-files: {listed.stderr.strip()}")
    paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    return [path for path in paths if path.is_file()]


def test_tracked_files_stay_below_25_mb(tracked):
    assert sum(path.stat().st_size for path in tracked) < TREE


def test_pictures_stay_below_300_kb(tracked):
    sizes = {path: path.stat().st_size for path in tracked if path.suffix in PICTURES}
    assert {path: size for path, size in sizes.items() if size >= PICTURE} == {}


def test_weights_are_in_their_folder_and_listed_with_sha256(tracked):
    files = [path for path in tracked if path.suffix in WEIGHTS]
    assert {path.parent for path in files} == {ROOT / "weights"}
    listed = (ROOT / "weights" / "README.md").read_text()
    sums = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    assert [name for name, digest in sums.items() if f"{digest}  {name}\n" not in listed] == []
    assert [name for name in sums if f"| `{name}` |" not in listed] == []


def test_weights_files_are_intact(tracked):
    for path in tracked:
        if path.suffix in WEIGHTS:
            content = torch.load(path, weights_only=True)
            assert weights.digest(content["state"]) == content["sha256"], path


def test_records_name_weights_that_exist(tracked):
    named: dict[Path, Path] = {}
    for path in tracked:
        if path.name == "result.json":
            files = json.loads(path.read_text())["files"]
            named |= {path.parent / files[k]: path for k in files if k.endswith("weights")}
    assert {path: record for path, record in named.items() if not path.is_file()} == {}
    kept = set((ROOT / "weights").glob("*.pt"))
    assert {path.resolve() for path in named} == kept
