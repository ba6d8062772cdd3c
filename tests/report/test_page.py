"""The page of a report, opened in a browser."""

import base64
import hashlib
import json
import re

import pytest
import torch

from mops_lightning.report.build import build_report
from mops_lightning.report.cli import main
from mops_lightning.report.page import page, render
from mops_lightning.report.text import PAPER, Grid
from mops_lightning.viz.figures import COLOURS, INPUT_COLOUR, save_clouds
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


def data_of(text):
    """The clouds in a page, as its script reads them."""
    (data,) = re.findall(r'<script [^>]*id="data"[^>]*>(.*?)</script>', text, re.DOTALL)
    return json.loads(data)


def test_page_holds_rounded_clouds_in_their_colours_and_hides_completed_sets(tmp_path):
    cloud = torch.tensor([[[0.12345, 0.5, -0.98765]]])
    sets = {"generated": cloud, "completed": cloud, "mine": cloud}
    path = put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.5}, files={"clouds": "c.npz"})
    save_clouds(path.parent / "c.npz", cloud, sets, ["<b>chair"])

    text = page(build_report(tmp_path), tmp_path, [])

    (shown,) = data_of(text)
    assert shown["name"] == "mops-32-pointnet"
    assert shown["titles"] == ["<b>chair"]
    assert list(shown["points"]) == ["input", "generated", "completed", "mine"]
    for points in shown["points"].values():
        assert points == [[[0.123, 0.5, -0.988]]]
    assert shown["hidden"] == ["completed"]
    assert shown["colours"]["input"] == f"rgb{INPUT_COLOUR}"
    assert shown["colours"]["generated"] == f"rgb{COLOURS['generated']}"
    assert shown["colours"]["mine"] == f"rgb{COLOURS['sampled']}"
    assert "<b>chair" not in text


def test_page_shows_the_clouds_of_at_most_24_runs_and_names_damaged_files(tmp_path):
    cloud = torch.rand(1, 4, 3)
    for number in range(26):
        scores = {"test/sampled/accuracy": 0.5}
        folder = tmp_path / f"{number:02}"
        path = put(folder, "fps", number + 1, scores, files={"clouds": "c.npz"})
        save_clouds(path.parent / "c.npz", cloud, {"sampled": cloud}, ["chair"])
    damaged = tmp_path / "03" / "fps-4-pointnet" / "c.npz"
    damaged.write_bytes(b"no clouds")

    text = page(build_report(tmp_path), tmp_path, [])

    numbers = [int(shown["name"].partition("/")[0]) for shown in data_of(text)]
    assert numbers == [0, 1, 2, *range(4, 25)]
    assert f"<li>{damaged}: " in text


def test_page_has_remarks_lines_below_tables_and_no_script_for_clouds_without_any():
    grid = Grid("a & b", ["*head*", "m"], [["<x>", "1"], [PAPER, "*2*"]], ["below & more"])

    text = render("title <", [grid], [], ["- first <", "", "between"], "made", choice="Run")

    assert "<h1>title &lt;</h1>" in text
    assert "<p>a &amp; b</p>" in text
    assert "<th>head</th><th>m</th>" in text
    assert (
        "<tr><td>&lt;x&gt;<small>the paper&#x27;s</small></td><td>1<small>2</small></td></tr>"
        in (text)
    )
    assert "<p>below &amp; more</p>" in text
    assert "<li>first &lt;</li></ul><p>between</p><ul>" in text
    assert "unsafe-eval" not in text
    assert "Sampled clouds" not in text


def test_page_of_groups_with_another_name_calls_them_so():
    group = {"name": "a", "titles": ["t"], "points": {}, "colours": {}, "hidden": []}

    text = render("title", [], [group], [], "made", choice="Sampler")

    assert "<label>Sampler <select" in text
    assert "unsafe-eval" in text
