"""The files that git tracks: a small tree, with all weights in the models of the package."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from mops_lightning.zoo import model_file, names, weights

ROOT = Path(__file__).parents[1]
TREE = 40_000_000
MODELS = 30_000_000
PICTURE = 300_000
PICTURES = {".png", ".svg", ".jpg", ".jpeg", ".gif", ".webp"}
WEIGHTS = {".pt", ".ckpt", ".safetensors", ".onnx"}
KINDS = ("weights", "task_weights")


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


def test_tracked_files_stay_below_40_mb_and_pictures_below_300_kb(tracked):
    total = 0
    for path in tracked:
        size = path.stat().st_size
        total += size
        if path.suffix in PICTURES:
            assert size < PICTURE, path
    assert total < TREE


def test_results_have_at_most_150_files(tracked):
    files = [path for path in tracked if path.is_relative_to(ROOT / "results")]

    assert len(files) <= 150


def test_weights_are_models_of_the_package(tracked):
    files = [path for path in tracked if path.suffix in WEIGHTS]

    total = 0
    for path in files:
        total += path.stat().st_size
        assert path.parent == names.SHIPPED
        assert model_file.read_card(path)["name"] == path.stem
        weights.read(path)
    assert files
    assert total < MODELS


def records_of(tracked):
    """Return the records of all tables and all cards of models."""
    records = []
    for path in tracked:
        if path.name == "runs.jsonl":
            for line in path.read_text().splitlines():
                records.append(json.loads(line))
        elif path.suffix in WEIGHTS:
            records.append(model_file.read_card(path)["record"])
    return records


def test_records_and_models_name_models_that_exist(tracked):
    models = {path for path in tracked if path.suffix in WEIGHTS}

    named = set()
    for record in records_of(tracked):
        for kind, name in record["files"].items():
            is_file_of_run = name.endswith(".safetensors")  # in the run's folder, not kept
            if kind in KINDS and not is_file_of_run:
                named.add(names.find_model(name))

    assert named == models


def test_pages_set_arguments_without_a_plus():
    added = re.compile(r"(^|[ `])\+(sampler|recipe|task|optimizer)\.", re.MULTILINE)
    pages = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("results/**/README.md")]
    for path in [*pages, *ROOT.glob("sweeps/**/*.yaml")]:
        assert not added.search(path.read_text()), path
