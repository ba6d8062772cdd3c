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
    is_ignored = False
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    for line in lines:
        pattern = line.strip()
        if not pattern or pattern.startswith("#"):
            continue
        is_exception = pattern.startswith("!")
        expression = regular_expression(pattern.removeprefix("!"))
        if re.fullmatch(f"{expression}(/.*)?", path):  # a folder stands for its content
            is_ignored = not is_exception
    return is_ignored


WILDCARDS = {
    r"\*\*/": "(.*/)?",
    r"\*": "[^/]*",
    r"\?": "[^/]",
    r"\[": "[",
    r"\]": "]",
}
"""Wildcards of .dockerignore, escaped, as regular expressions, in the order of replacement."""


def regular_expression(pattern: str) -> str:
    """Return the regular expression of a pattern of .dockerignore."""
    expression = re.escape(pattern.strip("/"))
    for wildcard, replacement in WILDCARDS.items():
        expression = expression.replace(wildcard, replacement)
    return expression


def files_of(path: Path) -> list[str]:
    """Return the files that git would have at a path, relative to the repository."""
    files = [path]
    if path.is_dir():
        files = [file for file in path.rglob("*") if file.is_file()]
    names = [file.relative_to(ROOT).as_posix() for file in files]
    return [name for name in names if not re.search(r"__pycache__|\.egg-info", name)]


@pytest.mark.parametrize("name", DOCKERFILES)
def test_copied_sources_exist_in_the_build_context(name):
    sources = copied(name)
    assert "constraints.txt" in sources
    for source in sources:
        path = ROOT / source
        assert path.exists(), source
        names = files_of(path)
        missing = [name for name in names if ignored(name)]
        assert names
        assert not missing


@pytest.mark.parametrize("name", DOCKERFILES)
def test_copied_sources_suffice_for_the_wheel(name):
    content = (ROOT / "pyproject.toml").read_text()
    pyproject = tomllib.loads(content)
    project = pyproject["project"]
    wheel = pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]

    needed = {"pyproject.toml", project["readme"]}
    needed.update(project["license-files"])
    needed.update(wheel["force-include"])
    for package in wheel["packages"]:
        folder, _, _ = package.partition("/")
        needed.add(folder)

    assert needed <= copied(name)


@pytest.mark.parametrize("name", DOCKERFILES)
def test_pip_install_uses_the_constraints(name):
    steps: list[str] = []
    for line in commands(name):
        steps.extend(line.split("&&"))
    installs = [step for step in steps if "pip install" in step]

    assert installs
    for step in installs:
        assert " -c constraints.txt " in step


@pytest.mark.parametrize("name", DOCKERFILES)
def test_image_reads_las_files(name):
    (step,) = [line for line in commands(name) if "import tomllib" in line]
    _, _, quoted = step.partition('python -c "')
    code, _, _ = quoted.partition('"')

    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)

    requirements = done.stdout.splitlines()
    assert any(line.startswith("laspy[lazrs]") for line in requirements)
    assert any(line.startswith("torch>=") for line in requirements)
