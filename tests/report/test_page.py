"""The page of a report, opened in a browser."""

import base64
import hashlib
import re

import pytest
import torch

from mops_lightning.report.cli import main
from mops_lightning.viz.figures import save_clouds
from tests.support.reports import put, put_planes


def cells(page, table=0):
    """The visible texts in the body of a table."""
    body = page.locator("table").nth(table)
    texts = []
    for row in body.locator("tbody tr").all():
        texts.append(row.locator("td").all_inner_texts())
    return texts


def names(page):
    """The first line of the first cell of every row."""
    first_cells = [row[0] for row in cells(page)]
    return [cell.splitlines()[0] for cell in first_cells]


def kinds(requests):
    """The kinds of addresses that a page asked for."""
    return {address.partition(":")[0] for address in requests}


LOCAL = {"file", "data", "blob"}
"""Kinds of addresses that leave the machine alone."""


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """The report of a folder of records, two with clouds."""
    tmp_path = tmp_path_factory.mktemp("reported")
    rng = torch.Generator().manual_seed(0)
    put(tmp_path, "fps", 8, {"test/sampled/accuracy": 0.4})
    put(tmp_path, "voxel", 32, {"test/sampled/accuracy": 0.055})
    of_fps = {"test/sampled/accuracy": 0.3, "test/full/accuracy": 0.9}
    of_mops = {"test/generated/accuracy": 0.8, "test/matched/accuracy": 0.77}
    for sampler, readout, metrics in (("fps", "sampled", of_fps), ("mops", "generated", of_mops)):
        path = put(tmp_path, sampler, 32, metrics, files={"clouds": "clouds.npz"})
        points = torch.rand(2, 50, 3, generator=rng)
        drawn = {readout: points[:, :8]}
        save_clouds(path.parent / "clouds.npz", points, drawn, ["0_chair", "1_</script>"])
    main([str(tmp_path)])
    return tmp_path / "report.html"


@pytest.fixture(scope="module")
def shown(reported, opened_once):
    """The report in the browser; no test reads what another one changes."""
    page, errors, requests = opened_once(f"file://{reported}")
    page.wait_for_selector("#view canvas")
    return page, errors, requests


def test_page_tables_sort_by_column(shown):
    page, errors, requests = shown
    of_size = page.get_by_role("columnheader", name="m=32")
    of_name = page.get_by_role("columnheader", name="sampled by")

    assert names(page) == ["voxel", "fps", "mops"]
    assert cells(page)[1] == ["fps\nthe paper's", "30.00\n34.08", "40.00\n11.02"]

    of_size.click()
    assert names(page) == ["voxel", "fps", "mops"]

    of_size.click()
    assert names(page) == ["mops", "fps", "voxel"]

    of_name.click()
    assert names(page) == ["fps", "mops", "voxel"]

    assert page.locator("img").evaluate("image => image.naturalWidth") > 300
    assert errors == []
    assert kinds(requests) <= LOCAL


def test_page_clouds_can_be_selected(shown):
    page, errors, requests = shown
    assert page.locator("#run option").all_inner_texts() == ["fps-32-pointnet", "mops-32-pointnet"]
    assert page.locator("#shape option").all_inner_texts() == ["0_chair", "1_</script>"]
    traces = "document.getElementById('view').data.map(trace => [trace.name, trace.x.length])"
    assert page.evaluate(traces) == [["input", 50], ["sampled", 8]]

    page.select_option("#run", "1")
    page.select_option("#shape", "1")
    assert page.evaluate(traces) == [["input", 50], ["generated", 8]]

    view = page.locator("#view")
    drawn = view.screenshot()
    page.evaluate("Plotly.restyle('view', {visible: false})")
    page.wait_for_timeout(300)
    assert view.screenshot() != drawn, "the canvas must show the points"

    page.evaluate("Plotly.restyle('view', {visible: true})")  # for the tests that follow
    assert errors == []
    assert kinds(requests) <= LOCAL


def test_page_planes_have_table_and_plot(tmp_path, opened):
    put_planes(tmp_path)
    main([str(tmp_path)])
    page, errors, _ = opened(f"file://{tmp_path}/report.html")
    assert cells(page, 1)[1] == ["1", "1.5 / 2", "1.9 / 2"]
    assert page.locator("img").evaluate("image => image.naturalWidth") > 300
    assert page.locator("#view").count() == 0, "no run has saved clouds"
    assert errors == []


def test_page_runs_its_own_scripts_only(reported):
    text = reported.read_text()
    (policy,) = re.findall('Content-Security-Policy" content="([^"]*)"', text)
    assert "default-src 'none'" in policy
    digests = set()
    for script in re.findall("<script>(.*?)</script>", text, re.DOTALL):
        digest = hashlib.sha256(script.encode()).digest()
        digests.add(base64.b64encode(digest).decode())
    allowed = re.findall("'sha256-([^']*)'", policy)
    assert digests == set(allowed)
    assert len(digests) == 2
    assert '<meta name="viewport"' in text
