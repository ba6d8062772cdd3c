"""The documentation site, built as ``make site`` builds it and opened in a browser."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import mops_lightning
from tests.support.served import served

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_reference_lists_every_public_name(site):
    text = (site / "reference.html").read_text()
    for name in mops_lightning.__all__:
        module = getattr(mops_lightning, name).__module__
        assert f'id="{module}.{name}"' in text, name


def test_every_docs_page_is_in_the_navigation(site):
    home = (site / "index.html").read_text()
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"README"}
    assert pages
    assert {page for page in pages if f'href="{page}.html"' not in home} == set()


def test_links_lead_to_files_and_anchors_of_the_site(site):
    broken = []
    for page in site.rglob("*.html"):
        if page.name == "404.html":
            continue
        for link in re.findall(r'(?:href|src)="([^"]+)"', page.read_text()):
            path, _, anchor = link.partition("#")
            if ":" in path or link.startswith("//"):
                continue
            target = (page.parent / path).resolve() if path else page
            target = target / "index.html" if target.is_dir() else target
            found = target.is_file()
            if found and anchor and target.suffix == ".html":
                found = f'id="{anchor}"' in target.read_text()
            if not found:
                broken.append((page.name, link))
    assert broken == []


@pytest.fixture(scope="module")
def address(site):
    """Serve the site: browsers refuse the search index of pages from the disk."""
    with served(site) as (address, _):
        yield address


@pytest.mark.parametrize("name", ["index", "gallery", "reference", "notebooks/quickstart"])
def test_page_opens_without_errors_and_with_its_pictures(address, opened, name):
    page, errors, requests = opened(f"{address}/{name}.html")
    assert page.locator("h1").first.is_visible()
    empty = "[...document.images].filter(i => !(i.complete && i.naturalWidth)).map(i => i.src)"
    assert page.evaluate(empty) == []
    wide = page.evaluate("document.documentElement.scrollWidth - window.innerWidth")
    assert wide <= 0
    assert errors == []
    assert [request for request in requests if not request.startswith(address)] == []


def test_search_finds_a_setting(address, opened):
    page, errors, _ = opened(f"{address}/index.html")
    page.wait_for_load_state("networkidle")
    page.locator("input.md-search__input").press_sequentially("test_noise_std")
    page.locator(".md-search-result__item").first.wait_for(state="attached")
    assert errors == []
