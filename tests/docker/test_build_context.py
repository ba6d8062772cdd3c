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
    lines = (ROOT / "docker" / f"{name}.Dockerfile").read_text().splitlines()
    text = "\n".join(line for line in lines if not line.startswith("#"))
    return [line for line in text.replace("\\\n", "").splitlines() if line]


def copied(name: str) -> set[str]:
    """Return what is copied from the build context."""
    copies = [line.split()[1:-1] for line in commands(name) if line.startswith("COPY ")]
    return {source for sources in copies if sources[0][:2] != "--" for source in sources}


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
    project, wheel = pyproject["project"], pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {"pyproject.toml", project["readme"], *project["license-files"]}
    needed |= {package.split("/")[0] for package in wheel["packages"]} | {*wheel["force-include"]}
    assert needed <= copied(name)


@pytest.mark.parametrize("name", DOCKERFILES)
def test_pip_install_uses_the_constraints(name):
    steps = [step for line in commands(name) for step in line.split("&&")]
    installs = [step for step in steps if "pip install" in step]
    assert installs
    assert all(" -c constraints.txt " in step for step in installs)


@pytest.mark.parametrize("name", DOCKERFILES)
def test_image_reads_las_files(name):
    step = next(line for line in commands(name) if "import tomllib" in line)
    code = step.split('python -c "')[1].split('"')[0]

    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)

    requirements = done.stdout.splitlines()
    assert [line for line in requirements if line.startswith("laspy[lazrs]")]
    assert [line for line in requirements if line.startswith("torch>=")]
