"""MkDocs hooks: pages from outside docs/, links that work in the repository and on the site."""

import base64
import json
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

import mops_lightning

ROOT = Path(__file__).parents[2]
DOCS = "docs/"
HOME = "README.md"
PAGES = (
    HOME,
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "MAINTAINING.md",
    "SECURITY.md",
    "results/PROTOCOL.md",
)
"""Pages outside docs/, beside those of results and benchmarks."""

MAX_BYTES = 1_000_000
"""Larger files are not copied; a link to one becomes plain text."""

IN_MODULES = (
    "mops_lightning.config.compose.compose",
    "mops_lightning.training.run.run.run",
    "mops_lightning.zoo.publish.add",
    "mops_lightning.zoo.weights.load_into",
)
"""Public names that are not imported from the package itself."""

LINK = re.compile(r"(?P<mark>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)\s]+)\)")
FENCE = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside docs/, the reference, and every file that a page links to."""
    outside = [ROOT / name for name in PAGES]
    outside += [ROOT / "benchmarks" / HOME, *ROOT.glob("results/*/*.md")]
    outside += ROOT.glob("results/*/*/*.md")
    pages = [path for path in outside if path.is_file()]
    for path in pages:
        files.append(File.generated(config, _site(_name(path)), abs_src_path=str(path)))
    files.append(File.generated(config, "reference.md", content=_reference()))
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        for uri, content in _notebook(path).items():
            files.append(File.generated(config, uri, content=content))
    linked = {
        target
        for path in [*pages, *(ROOT / "docs").glob("*.md")]
        for link in LINK.finditer(FENCE.sub("", path.read_text(encoding="utf-8")))
        if (target := _target(_name(path), link["target"])) and _is_copied(target)
    }
    for name in sorted(linked):
        if files.get_file_from_path(_site(name)) is None:
            files.append(File.generated(config, _site(name), abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Any, files: Files, **_: Any) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    source = _repository(page.file.src_uri)

    def rewrite(link: re.Match[str]) -> str:
        target = _target(source, link["target"])
        if target is None:
            return link[0]
        anchor = link["target"].partition("#")[2]
        if files.get_file_from_path(_site(target)) is None:
            return link["text"]
        start = posixpath.dirname(page.file.src_uri) or "."
        there = posixpath.relpath(_site(target), start) + (f"#{anchor}" if anchor else "")
        return f"{link['mark']}[{link['text']}]({there})"

    parts, last = [], 0
    for fence in FENCE.finditer(markdown):  # code is left as it is
        parts += [LINK.sub(rewrite, markdown[last : fence.start()]), fence[0]]
        last = fence.end()
    return "".join([*parts, LINK.sub(rewrite, markdown[last:])])


def _target(source: str, link: str) -> str | None:
    """Return the repository path that a link of a file means; None for other links."""
    path = link.partition("#")[0]
    if not path or ":" in path:
        return None
    target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    if (ROOT / target).is_dir():
        target = posixpath.join(target, HOME)
    return target


def _is_copied(name: str) -> bool:
    path = ROOT / name
    return path.is_file() and path.stat().st_size <= MAX_BYTES


def _name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def _site(name: str) -> str:
    """Return where a file of the repository is on the site."""
    if name in (HOME, DOCS + HOME):
        return "index.md"
    return name.removeprefix(DOCS).replace(".ipynb", ".md")


def _repository(uri: str) -> str:
    """Return the file of the repository that is at a place of the site."""
    if uri == "index.md":
        return HOME
    return uri if (ROOT / uri).is_file() else DOCS + uri


def _notebook(path: Path) -> dict[str, str | bytes]:
    """Return a notebook as a page and its pictures, by their places on the site."""
    made: dict[str, str | bytes] = {}
    lines: list[str] = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            lines += [source, ""]
            continue
        lines += ["```python", source, "```", ""]
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}-{len(made)}.png"
                made[f"notebooks/{name}"] = base64.b64decode(data["image/png"])
                lines += [f"![output]({name})", ""]
            else:
                text = "".join(output.get("text") or data["text/plain"])
                lines += ["```text", text.rstrip(), "```", ""]
    return {f"notebooks/{path.stem}.md": "\n".join(lines), **made}


def _reference() -> str:
    """Return a page with every public name, by package."""
    lines = [
        "# Reference",
        "",
        "`from mops_lightning import NAME` imports all names except those of the last section.",
        "",
    ]
    packages: dict[str, list[str]] = {}
    for name in mops_lightning.__all__:
        module = getattr(mops_lightning, name).__module__
        packages.setdefault(module.split(".")[1], []).append(f"::: {module}.{name}")
    for package in sorted(packages):
        lines += [f"## {package}", "", *(line for one in packages[package] for line in (one, ""))]
    lines += ["## In modules of their own", ""]
    for name in IN_MODULES:
        lines += [f"`from {' import '.join(name.rsplit('.', 1))}`", "", f"::: {name}", ""]
    return "\n".join(lines)
