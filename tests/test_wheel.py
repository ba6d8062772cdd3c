"""The wheel, built, installed and used outside the checkout, and the source distribution."""

import json
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# .gitignore too: hatchling leaves out of the wheel what git ignores.
SOURCES = ("pyproject.toml", "README.md", "LICENSE", ".gitignore", "src", "conf", "sweeps")
TINY_JOB = (
    "learn=task",
    # An installed copy compiles its loops anew; these sampled points need none.
    "sampler=random",
    "baselines={}",
    "dataset=shapes",
    "dataset.train_per_class=4",
    "dataset.test_per_class=2",
    "dataset.n_points=64",
    "batch_size=16",
    "m=8",
    "trainer=cpu",
    "trainer.max_epochs=1",
)


def python(*arguments: str, cwd: Path, path: Path | None = None) -> str:
    """Run this interpreter in another folder and return its output."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    environment.pop("PYTHONPATH", None)
    if path is not None:
        # Comes before site-packages and so before the editable install that is found there.
        environment["PYTHONPATH"] = str(path)
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy, so that the checkout stays clean."""
    copy = tmp_path_factory.mktemp("copy")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            compiled = shutil.ignore_patterns("__pycache__", "*.egg-info")
            shutil.copytree(ROOT / name, copy / name, ignore=compiled)
        else:
            shutil.copyfile(ROOT / name, copy / name)
    python("-m", "build", "--wheel", "--no-isolation", "--outdir", "dist", cwd=copy)
    (built,) = (copy / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("installed")
    pip = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-compile")
    python(*pip, "--target", str(folder), str(wheel), cwd=folder)
    return folder


def files_below(folder: Path, inside: str) -> set[str]:
    """List the files of a folder by their expected names in the wheel."""
    names = set()
    for file in folder.rglob("*"):
        path = file.relative_to(folder)
        if file.is_file() and "__pycache__" not in path.parts:
            names.add(f"{inside}/{path.as_posix()}")
    return names


def test_wheel_contains_package_configs_console_script_and_licence_only(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (info,) = {name.split("/")[0] for name in names if ".dist-info/" in name}
        scripts = archive.read(f"{info}/entry_points.txt").decode().splitlines()
        licence = archive.read(f"{info}/licenses/LICENSE")

    assert licence == (ROOT / "LICENSE").read_bytes()
    title = scripts.index("[console_scripts]")
    assert scripts[title + 1] == "mops-lightning = mops_lightning.cli.main:main"
    packed = {name for name in names if not name.startswith(f"{info}/")}
    package = files_below(ROOT / "src" / "mops_lightning", "mops_lightning")
    plugins = files_below(ROOT / "src" / "hydra_plugins", "hydra_plugins")
    configs = files_below(ROOT / "conf", "mops_lightning/conf")
    sweeps = files_below(ROOT / "sweeps", "mops_lightning/sweeps")
    assert "mops_lightning/conf/config.yaml" in configs
    assert "mops_lightning/sweeps/modelnet40.yaml" in sweeps
    assert "mops_lightning/report/paper.json" in packed
    assert "mops_lightning/py.typed" in packed
    assert packed == package | plugins | configs | sweeps


def test_run_of_installed_copy_leaves_a_record(installed: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "empty"
    elsewhere.mkdir()
    folders = [f"out={tmp_path / 'out'}", f"cache={tmp_path / 'cache'}"]

    python("-m", "mops_lightning", *TINY_JOB, *folders, cwd=elsewhere, path=installed)

    (result,) = (tmp_path / "out").rglob("result.json")
    record = json.loads(result.read_text())
    assert record["status"] == "completed"
    # Only a checkout has a commit: one more sign that it was not the checkout that ran.
    assert record["git"] == {"commit": None, "dirty": None}
    assert list(elsewhere.iterdir()) == []


def test_sweep_of_installed_copy_is_found_by_its_name(installed: Path, tmp_path: Path) -> None:
    command = ["-m", "mops_lightning", "--config-name", "ablation", "--cfg", "job"]

    shown = python(*command, cwd=tmp_path, path=installed)

    assert "n_points: 256" in shown  # of this sweep alone


def test_source_distribution_contains_every_tracked_file(tmp_path: Path) -> None:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git checkout")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    tracked = set()
    for name in listed.stdout.split("\0"):
        if name and (ROOT / name).is_file():
            tracked.add(name)

    python("-m", "build", "--sdist", "--no-isolation", "--outdir", str(tmp_path), cwd=ROOT)

    (built,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert len(tracked) > 400
    assert tracked - packed == {".ci/run"}
