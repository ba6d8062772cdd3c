import csv
import re

import numpy as np
import pytest

from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.files.cli import compare as main
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import weights
from mops_lightning.zoo.names import UNTRAINED
from tests.support.captured import captured, done, refused


def call(*arguments):
    return captured(main, arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    random = np.random.default_rng(0)
    for name in ("one.ply", "two.pcd"):
        points = random.normal(size=(700, 3)) * [5, 3, 1] + [400_000, 0, 0]
        WRITERS[f".{name[-3:]}"](folder / name, Table(points, {"intensity": points[:, 0] / 3}))
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 32}
    weights.save(
        folder / "weights.safetensors", FMOPSNet(32), {"learn": "sampler", "sampler": node}, {}
    )
    return folder


def test_compare_writes_table_and_page(folder, tmp_path):
    arguments = [folder / "one.ply", folder / "two.pcd", "--m", 60, 90, "--out", tmp_path]
    out = done(main, [*arguments, "--weights", folder, "--tile", 128])
    assert "one.ply: 60 of 700 points" in out
    assert "two.pcd: 90 of 700 points" in out
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * (len(UNTRAINED) + 1)
    assert {row["method"] for row in rows} == {*UNTRAINED, "trained"}
    largest = {row["method"]: float(row["hausdorff"]) for row in rows}
    assert largest["fps"] < largest["random"]
    assert all(float(row[name]) > 0 for row in rows for name in ("chamfer", "density", "seconds"))
    page = (tmp_path / "compare.html").read_text()
    assert "two.pcd, 90 points" in page
    assert "How to read this" in page


def test_compare_columns_name_those_of_bin_files(folder, tmp_path):
    points = np.random.default_rng(0).normal(size=(300, 3))
    WRITERS[".ply"](tmp_path / "scan.ply", Table(points.astype(np.float32).astype(float)))
    np.insert(points, 0, 7.0, axis=1).astype(np.float32).tofile(tmp_path / "scan.bin")
    arguments = ["--m", 30, "--methods", "fps"]

    done(main, [tmp_path / "scan.ply", *arguments, "--out", tmp_path / "ply"])
    named = [*arguments, "--columns", "intensity,x,y,z", "--out", tmp_path / "bin"]
    done(main, [tmp_path / "scan.bin", *named])

    tables = [(tmp_path / kind / "table.csv").read_text() for kind in ("ply", "bin")]
    distances = [text.splitlines()[1].split(",")[4:6] for text in tables]
    assert distances[0] == distances[1]


def test_compare_keeps_an_earlier_comparison(folder, tmp_path):
    arguments = [folder / "one.ply", "--m", 30, "--methods", "random", "--out", tmp_path]
    assert call(*arguments)[0] == 0
    earlier = (tmp_path / "table.csv").read_text()
    err = refused(main, [*arguments, "--seed", 1])
    assert re.search(r"--out: .*table.csv exists.*--overwrite", err)
    assert (tmp_path / "table.csv").read_text() == earlier
    assert call(*arguments, "--seed", 1, "--overwrite")[0] == 0
    distances = [text.split(",")[-5:-1] for text in (earlier, (tmp_path / "table.csv").read_text())]
    assert distances[0] != distances[1]


def test_compare_page_opens_without_errors(folder, tmp_path, opened):
    call(folder / "one.ply", "--m", 30, "--methods", "random", "--out", tmp_path)
    page, errors, requests = opened((tmp_path / "compare.html").as_uri())
    page.wait_for_selector("#view .legend")
    assert page.locator("#view .legendtext").all_text_contents() == ["input", "random"]
    assert (errors, len(requests)) == ([], 1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--m", 5, "--tile", 64], "give --weights"),
        (["--m", 5, "--methods", "fsp"], "--methods: unknown 'fsp'.*'fps'"),
        (["--m", 5, "--columns", "x,y,z"], "--columns is for .bin files"),
        (["--m", 0], "--m must be"),
        (["--m", 701], "fewer than --m 701"),
        (["--m", 60, "--weights", "FOLDER"], "trained for up to 32 points, got 60"),
        (["--m", 5, "--out", "FOLDER/one.ply"], "--out must be a folder"),
        (["--m", 5, "--out", "FOLDER", "--overwrite"], "has other files, such as one.ply"),
    ],
)
def test_compare_mistake_ends_in_one_line(arguments, said, folder):
    arguments = [str(argument).replace("FOLDER", str(folder)) for argument in arguments]
    assert re.search(said, refused(main, [folder / "one.ply", *arguments]))
