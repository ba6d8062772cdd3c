"""What can be known of the images without a Docker daemon."""

import json
import re
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
DOCKERFILES = ("docker/cpu.Dockerfile", "docker/cuda.Dockerfile")


class Step(NamedTuple):
    stage: int
    instruction: str
    rest: str


def steps(dockerfile: str) -> list[Step]:
    """Parse a Dockerfile in shell form: comments dropped, continued lines joined."""
    lines = (ROOT / dockerfile).read_text().splitlines()
    text = "\n".join(line for line in lines if not line.lstrip().startswith("#"))
    found, stage = [], -1
    for line in re.sub(r"\\\n\s*", "", text).splitlines():
        if line.strip():
            instruction, rest = line.strip().split(maxsplit=1)
            stage += instruction.upper() == "FROM"
            found.append(Step(stage, instruction.upper(), rest))
    return found


def final(dockerfile: str, instruction: str) -> list[str]:
    """Return what the last stage says under one instruction, in order."""
    found = steps(dockerfile)
    return [s.rest for s in found if s.stage == found[-1].stage and s.instruction == instruction]


def copied(dockerfile: str) -> list[tuple[int, str]]:
    """Return stage and source of everything that is copied from the build context."""
    sources = []
    for step in steps(dockerfile):
        words = step.rest.split()
        if step.instruction == "COPY" and not any(w.startswith("--from") for w in words):
            paths = [word for word in words if not word.startswith("--")]
            sources += [(step.stage, path.rstrip("/")) for path in paths[:-1]]
    return sources


def ignored(path: str) -> bool:
    """Say as Docker does whether .dockerignore keeps a path out: the last matching line rules."""
    out = False
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        pattern = line.strip()
        if pattern and not pattern.startswith("#"):
            glob = re.escape(pattern.removeprefix("!").strip("/"))
            glob = glob.replace(r"\*\*/", "(.*/)?").replace(r"\*", "[^/]*").replace(r"\?", "[^/]")
            glob = glob.replace(r"\[", "[").replace(r"\]", "]")
            # A line that matches a folder holds for all that is in it.
            if re.fullmatch(f"{glob}(/.*)?", path):
                out = not pattern.startswith("!")
    return out


def contents(path: Path) -> list[str]:
    """List a file, or the files below a folder, relative to the root; no compiled ones."""
    files = [path] if path.is_file() else [f for f in path.rglob("*") if f.is_file()]
    names = [file.relative_to(ROOT).as_posix() for file in files]
    return [name for name in names if "__pycache__" not in name and ".egg-info" not in name]


def made_user(dockerfile: str) -> tuple[int, str]:
    """Return number and name of the user that the last stage makes."""
    found = re.search(r"useradd .*--uid (\d+) (\w+)", "\n".join(final(dockerfile, "RUN")))
    assert found, f"{dockerfile} makes no user"
    return int(found[1]), found[2]


@pytest.mark.parametrize("dockerfile", DOCKERFILES)
def test_every_copied_source_exists_and_is_in_the_build_context(dockerfile: str) -> None:
    sources = copied(dockerfile)
    assert sources
    for _, source in sources:
        assert (ROOT / source).exists(), f"{dockerfile} copies {source}, which is not there"
        out = [name for name in contents(ROOT / source) if ignored(name)]
        assert not out, f".dockerignore keeps {out} out of the build context"


@pytest.mark.parametrize("dockerfile", DOCKERFILES)
def test_the_builder_has_all_that_the_wheel_is_made_of(dockerfile: str) -> None:
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project, wheel = pyproject["project"], pyproject["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {"pyproject.toml", project["readme"], *project["license-files"]}
    needed |= {package.split("/")[0] for package in wheel["packages"]} | {*wheel["force-include"]}
    assert needed <= {source for stage, source in copied(dockerfile) if stage == 0}


@pytest.mark.parametrize(
    "path",
    [
        ".git/config",
        ".venv/bin/python",
        "data/modelnet40_ply_hdf5_2048/ply_data_train0.h5",
        "outputs/classification/result.json",
        "src/mops_lightning/__pycache__/cli.cpython-312.pyc",
        "src/mops_lightning/samplers/__pycache__/base.cpython-312.pyc",
    ],
)
def test_what_no_image_needs_stays_out_of_the_build_context(path: str) -> None:
    assert ignored(path)


@pytest.mark.parametrize("dockerfile", DOCKERFILES)
def test_the_image_runs_the_command_line_as_a_plain_user(dockerfile: str) -> None:
    assert [json.loads(e) for e in final(dockerfile, "ENTRYPOINT")] == [
        ["python", "-m", "mops_lightning"]
    ]
    # A number, so that a cluster can see without the image's passwd that it is not root.
    number = int(final(dockerfile, "USER")[-1].split(":")[0])
    assert number == made_user(dockerfile)[0] > 0


@pytest.mark.parametrize("dockerfile", DOCKERFILES)
def test_the_user_can_write_to_the_work_folder_and_the_cache_is_below_it(dockerfile: str) -> None:
    folder = final(dockerfile, "WORKDIR")[-1]
    environment = dict(pair.split("=", 1) for e in final(dockerfile, "ENV") for pair in e.split())
    cache = environment["MOPS_CACHE"]
    assert Path(folder) in Path(cache).parents
    runs = "\n".join(final(dockerfile, "RUN"))
    made = re.search(r"install --directory (.*)", runs)
    assert made, f"{dockerfile} makes no folder"
    assert {f"--owner={made_user(dockerfile)[1]}", folder, cache} <= set(made[1].split())
    assert "oc.env:MOPS_CACHE" in (ROOT / "conf/config.yaml").read_text()


@pytest.mark.parametrize("dockerfile", DOCKERFILES)
def test_every_install_is_held_to_the_constraints(dockerfile: str) -> None:
    found = steps(dockerfile)
    for stage in {step.stage for step in found}:
        runs = [s.rest for s in found if s.stage == stage and s.instruction == "RUN"]
        installs = [c for run in runs for c in run.split("&&") if "pip install" in c]
        assert installs
        assert all(" -c constraints.txt " in command for command in installs)
        assert (stage, "constraints.txt") in copied(dockerfile)


@pytest.mark.parametrize("dockerfile", DOCKERFILES)
def test_bases_are_pinned_and_no_address_is_built_in(dockerfile: str) -> None:
    bases = [step.rest.split()[0] for step in steps(dockerfile) if step.instruction == "FROM"]
    assert len(bases) == 2
    assert all(re.search(r":\d+\.\d+\.\d+-", base) for base in bases)
    assert final(dockerfile, "ARG") == ['PIP_EXTRA_INDEX_URL=""']
    assert "://" not in (ROOT / dockerfile).read_text()
