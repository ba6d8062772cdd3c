"""What an image is built from; hadolint checks the rest of the Dockerfiles."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCKERFILES = ("cpu", "cuda")


def commands(name: str) -> list[str]:
    """Return the lines of a Dockerfile without comments, continued lines joined."""
    content = (ROOT / "docker" / f"{name}.Dockerfile").read_text()
    lines = [line for line in content.splitlines() if not line.startswith("#")]
    joined = "\n".join(lines).replace("\\\n", "")
    return [line for line in joined.splitlines() if line]


def copied(name: str) -> set[str]:
    """Return what is copied from the build context."""
    sources: set[str] = set()
    for command in commands(name):
        if command.startswith("COPY "):
            _, *paths, _ = command.split()
            is_from_another_stage = paths[0].startswith("--")
            if not is_from_another_stage:
                sources.update(paths)
    return sources


def ignored(path: str) -> bool:
    """Return whether .dockerignore excludes a path; as in Docker, the last match decides."""
    out = False
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        pattern = line.strip()
        if pattern and not pattern.startswith("#"):
            glob = re.escape(pattern.removeprefix("!").strip("/"))
            glob = glob.replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*").replace(r"\?", "[^/]")
            glob = glob.replace(r"\[", "[").replace(r"\]", "]")
            if re.fullmatch(f"{glob}(/.*)?", path):  # a folder stands for its content
                out = not pattern.startswith("!")
    return out


@pytest.mark.parametrize("name", DOCKERFILES)
def test_copied_sources_exist_in_the_build_context(name):
    sources = copied(name)
    assert "constraints.txt" in sources
    for source in sources:
        path = ROOT / source
        assert path.exists(), source
        files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file()]
        names = [file.relative_to(ROOT).as_posix() for file in files]
        names = [name for name in names if not re.search(r"__pycache__|\.egg-info", name)]
        assert names
        assert not [name for name in names if ignored(name)]


@pytest.mark.parametrize("name", DOCKERFILES)
def test_copied_sources_suffice_for_the_wheel(name):
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = pyproject["project"]
    wheel = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]

    needed = {"pyproject.toml", project["readme"], *project["license-files"]}
    needed.update(wheel["force-include"])
    for package in wheel["packages"]:
        needed.add(package.partition("/")[0])

    assert needed <= copied(name)


@pytest.mark.parametrize("name", DOCKERFILES)
def test_pip_install_uses_the_constraints(name):
    steps = [step for line in commands(name) for step in line.split("&&")]
    installs = [step for step in steps if "pip install" in step]
    assert installs
    assert all(" -c constraints.txt " in step for step in installs)


@pytest.mark.parametrize("name", DOCKERFILES)
def test_image_reads_las_files(name):
    (step,) = [line for line in commands(name) if "import tomllib" in line]
    _, _, quoted = step.partition('python -c "')
    code, _, _ = quoted.partition('"')

    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)

    requirements = done.stdout.splitlines()
    assert any(line.startswith("laspy[lazrs]") for line in requirements)
    assert any(line.startswith("torch>=") for line in requirements)
