"""The page of a report, as a person sees it in a browser."""

import json

import pytest
import torch

from mops_lightning.records import run_record
from mops_lightning.report.cli import main
from mops_lightning.viz.snapshots import load_clouds, save_clouds
from tests.support.reports import put, put_planes


def cells(page, table=0):
    """What a reader sees in the body of a table."""
    found = page.locator("table").nth(table).locator("tbody tr")
    return [row.locator("td").all_inner_texts() for row in found.all()]


def names(page):
    return [row[0].splitlines()[0] for row in cells(page)]


@pytest.fixture
def reported(tmp_path, rng):
    """A folder of records, two with clouds, and its report."""
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3, "test/full/accuracy": 0.9})
    put(tmp_path, "fps", 8, {"test/sampled/accuracy": 0.4})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8, "test/matched/accuracy": 0.77})
    put(tmp_path, "voxel", 32, {"test/sampled/accuracy": 0.055})
    for name, readout in (("fps-32", "sampled"), ("mops-32", "generated")):
        path = tmp_path / f"{name}-pointnet" / run_record.FILE
        content = json.loads(path.read_text())
        content["files"]["clouds"] = "pictures/clouds.npz"
        path.write_text(json.dumps(content))
        points = torch.rand(2, 50, 3, generator=rng)
        titles = ["0_chair", "1_</script>"]
        save_clouds(
            path.parent / "pictures" / "clouds.npz", points, {readout: points[:, :8]}, titles
        )
    main([str(tmp_path)])
    return tmp_path / "report.html"


def test_tables_are_there_and_sort(reported, opened):
    page, errors, requests = opened(f"file://{reported}")
    before = cells(page)
    assert names(page) == ["voxel", "fps", "mops"]
    assert before[1] == ["fps\nthe paper's", "30.00\n34.08", "40.00\n11.02"]
    page.get_by_role("columnheader", name="m=32").click()
    assert names(page) == ["voxel", "fps", "mops"]
    page.get_by_role("columnheader", name="m=32").click()
    assert names(page) == ["mops", "fps", "voxel"]
    page.get_by_role("columnheader", name="sampled by").click()
    assert names(page) == ["fps", "mops", "voxel"]
    assert page.locator("img").evaluate("image => image.naturalWidth") > 300
    assert errors == []
    assert {url.split(":")[0] for url in requests} <= {"file", "data", "blob"}


def test_clouds_are_drawn_and_can_be_chosen(reported, opened):
    page, errors, requests = opened(f"file://{reported}")
    page.wait_for_selector("#view canvas")
    assert page.locator("#run option").all_inner_texts() == ["fps-32-pointnet", "mops-32-pointnet"]
    assert page.locator("#shape option").all_inner_texts() == ["0_chair", "1_</script>"]
    traces = "document.getElementById('view').data.map(trace => [trace.name, trace.x.length])"
    assert page.evaluate(traces) == [["input", 50], ["sampled", 8]]
    page.select_option("#run", "1")
    page.select_option("#shape", "1")
    assert page.evaluate(traces) == [["input", 50], ["generated", 8]]
    drawn = page.locator("#view").screenshot()
    page.evaluate("Plotly.restyle('view', {visible: false})")
    page.wait_for_timeout(300)
    assert page.locator("#view").screenshot() != drawn, "the canvas shows the points"
    assert errors == []
    assert {url.split(":")[0] for url in requests} <= {"file", "data", "blob"}


def test_planes_are_shown_on_one_scale(tmp_path, opened):
    put_planes(tmp_path)
    main([str(tmp_path)])
    page, errors, _ = opened(f"file://{tmp_path}/report.html")
    assert cells(page, 1)[1] == ["1.0", "1.5 / 2", "1.9 / 2"]
    assert page.locator("img").evaluate("image => image.naturalWidth") > 300
    assert page.locator("#view").count() == 0, "no run has kept clouds"
    assert errors == []


def test_clouds_are_kept_as_they_are_and_large_ones_thinned(tmp_path, rng):
    points = torch.rand(2, 20_000, 3, generator=rng)
    save_clouds(tmp_path / "clouds.npz", points, {"generated": points[:, :4096]}, ["a", "b"])
    titles, arrays = load_clouds(tmp_path / "clouds.npz")
    assert titles == ["a", "b"]
    assert list(arrays) == ["input", "generated"]
    assert arrays["input"].shape[1] <= 8192
    assert torch.equal(torch.from_numpy(arrays["generated"]), points[:, :4096])
