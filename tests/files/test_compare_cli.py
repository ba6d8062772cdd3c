import csv
import re

import numpy as np
import pytest
import trimesh

from mops_lightning.files.cli import compare as main
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import weights
from mops_lightning.zoo.names import UNTRAINED
from tests.support.captured import captured, done, refused
from tests.support.cloud_files import write_cloud
from tests.support.clouds import normal_points


def call(*arguments):
    return captured(main, arguments)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    for seed, name in enumerate(("one.ply", "two.pcd")):
        unit = normal_points(700, seed)
        points = unit * [5, 3, 1] + [400_000, 0, 0]
        intensity = points[:, 0] / 3
        write_cloud(folder / name, points, {"intensity": intensity})
    sampler = FMOPSNet(32)
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 32}
    config = {"learn": "sampler", "sampler": node}
    weights.save(folder / "weights.safetensors", sampler, config, {})
    return folder


def test_compare_writes_table_and_page(folder, tmp_path):
    files = [folder / "one.ply", folder / "two.pcd"]
    options = ["--m", 60, 90, "--weights", folder, "--tile", 128]

    out = done(main, [*files, *options, "--out", tmp_path])

    assert "one.ply: 60 of 700 points" in out
    assert "two.pcd: 90 of 700 points" in out
    with (tmp_path / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    files_and_sizes = 2 * 2
    methods = len(UNTRAINED) + 1
    assert len(rows) == files_and_sizes * methods
    largest = {}
    for row in rows:
        largest[row["method"]] = float(row["hausdorff"])
        assert float(row["chamfer"]) > 0
        assert float(row["density"]) > 0
        assert float(row["seconds"]) > 0
    assert set(largest) == {*UNTRAINED, "trained"}
    assert largest["fps"] < largest["random"]
    page = (tmp_path / "compare.html").read_text()
    assert "two.pcd, 90 points" in page
    assert "How to read this" in page


def distances_of_first_row(text):
    """Return the distances of the first row of a table, as they are written."""
    row = text.splitlines()[1]
    return row.split(",")[4:6]


def test_compare_columns_name_those_of_bin_files(folder, tmp_path):
    in_ply = tmp_path / "scan.ply"
    in_bin = tmp_path / "scan.bin"
    points = normal_points(300, 0).astype(np.float32)
    constant_first = np.insert(points, 0, 7.0, axis=1)
    constant_first.tofile(in_bin)
    write_cloud(in_ply, points.astype(float))
    options = ["--m", 30, "--methods", "fps"]
    columns = ["--columns", "intensity,x,y,z"]

    done(main, [in_ply, *options, "--out", tmp_path / "ply"])
    done(main, [in_bin, *options, *columns, "--out", tmp_path / "bin"])

    of_ply = (tmp_path / "ply" / "table.csv").read_text()
    of_bin = (tmp_path / "bin" / "table.csv").read_text()
    assert distances_of_first_row(of_bin) == distances_of_first_row(of_ply)


def test_compare_keeps_an_earlier_comparison(folder, tmp_path):
    table = tmp_path / "table.csv"
    arguments = [folder / "one.ply", "--m", 30, "--methods", "random", "--out", tmp_path]
    done(main, arguments)
    earlier = table.read_text()

    err = refused(main, [*arguments, "--seed", 1])

    assert re.search(r"--out: .*table.csv exists.*--overwrite", err)
    assert table.read_text() == earlier


@pytest.mark.parametrize("method", ["random", "fps"])
def test_compare_takes_points_of_a_mesh_and_of_methods_by_the_seed(method, tmp_path):
    mesh = tmp_path / "box.off"
    trimesh.creation.box().export(mesh)
    found = []
    for number, seed in enumerate((3, 3, 4)):
        out = tmp_path / str(number)
        done(main, [mesh, "--m", 9, "--methods", method, "--seed", seed, "--out", out])
        found.append(distances_of_first_row((out / "table.csv").read_text()))

    assert found[0] == found[1]
    assert found[0] != found[2]


def test_compare_page_opens_without_errors(folder, tmp_path, opened):
    path = tmp_path / "compare.html"
    call(folder / "one.ply", "--m", 30, "--methods", "random", "--out", tmp_path)

    page, errors, requests = opened(path.as_uri())

    page.wait_for_selector("#view .legend")
    legend = page.locator("#view .legendtext")
    assert legend.all_text_contents() == ["input", "random"]
    assert errors == []
    assert len(requests) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--m", 5, "--tile", 64], "give --weights"),
        (["--m", 5, "--methods", "fsp"], "--methods: unknown 'fsp'.*'fps'"),
        (["--m", 5, "--columns", "x,y,z"], "--columns is for .bin files"),
        (["--m", 5, "--max-distance", 1], "--max-distance is for --task icp"),
        (["--m", 5, "--sample-target"], "--sample-target is for --task icp"),
        (["--m", 5, "--seed", 2**63], "--seed must be from 0"),
        (["--m", 0], "--m must be"),
        (["--m", 701], "fewer than --m 701"),
        (["--m", 60, "--weights", "FOLDER"], "trained for up to 32 points, got 60"),
        (["--m", 5, "--out", "FOLDER/one.ply"], "--out must be a folder"),
        (["--m", 5, "--out", "FOLDER", "--overwrite"], "has other files, such as one.ply"),
    ],
)
def test_compare_mistake_ends_in_one_line(arguments, said, folder):
    arguments = [str(argument).replace("FOLDER", str(folder)) for argument in arguments]

    line = refused(main, [folder / "one.ply", *arguments])

    assert re.search(said, line)


def test_compare_overwrites_an_earlier_comparison_on_request(folder, tmp_path):
    table = tmp_path / "table.csv"
    arguments = [folder / "one.ply", "--m", 30, "--methods", "random", "--out", tmp_path]
    done(main, arguments)
    earlier = table.read_text()

    done(main, [*arguments, "--seed", 1, "--overwrite"])

    later = table.read_text()
    assert distances_of_first_row(later) != distances_of_first_row(earlier)
