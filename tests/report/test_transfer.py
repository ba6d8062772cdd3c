import csv

import pytest

from mops_lightning.errors import UserError
from mops_lightning.report.build import build
from mops_lightning.report.cli import write
from tests.support.reports import put, rows, table

NETS = {"dgcnn seed 0": ("aaaa", 0.5), "pointnet seed 1": ("bbbb", 0.9)}


def put_transfer(folder, sampler, m, value, nets=NETS, **changes):
    """A run whose scores under each further net are a share of those under its own."""
    ours = {f"{name}/accuracy": value for name in ("generated", "matched")}
    ours |= {"fps/accuracy": value / 2, "full/accuracy": 0.9}
    metrics = {f"test/{name}": one for name, one in ours.items()}
    for label, (_, share) in nets.items():
        metrics |= {f"transfer/{label}/{name}": share * one for name, one in ours.items()}
    notes = {
        label: {"sha256": sha256, "max_epochs": 20, "dataset": "modelnet40"}
        for label, (sha256, _) in nets.items()
    }
    put(folder, sampler, m, metrics, task_nets=notes, **changes)


def second(text):
    """Return the rows of the second table of a report."""
    found = rows(text)
    return found[[row[0] for row in found].index("m") :]


def test_transfer_grid_has_rows_by_size_and_column_per_net(tmp_path):
    put_transfer(tmp_path, "mops", 32, 0.8)
    put_transfer(tmp_path, "snet", 32, 0.6)
    put_transfer(tmp_path, "mops", 8, 0.4)
    text = table(tmp_path)
    assert second(text) == [
        ["m", "sampled by", "pointnet of the training", "dgcnn seed 0", "pointnet seed 1"],
        ["32", "fps", "30.00", "15.00", "27.00"],
        ["32", "snet", "60.00 / 60.00", "30.00 / 30.00", "54.00 / 54.00"],
        ["32", "mops", "80.00 / 80.00", "40.00 / 40.00", "72.00 / 72.00"],
        ["8", "fps", "20.00", "10.00", "18.00"],
        ["8", "mops", "40.00 / 40.00", "20.00 / 20.00", "36.00 / 36.00"],
        ["", "all points", "90.00", "45.00", "81.00"],
    ]
    assert "dgcnn seed 0: 20 epochs on modelnet40, sha256 aaaa." in text


def test_transfer_grid_of_two_seeds_shows_mean(tmp_path):
    for seed, value in enumerate((0.4, 0.6)):
        (tmp_path / f"{seed}").mkdir()
        put_transfer(tmp_path / f"{seed}", "mops", 32, value, seed=seed)
    (row,) = [row for row in second(table(tmp_path)) if row[1] == "mops"]
    assert row[3] == "25.00 ± 7.07 / 25.00 ± 7.07 (n=2)"


def test_transfer_grid_net_missing_in_a_run_is_blank(tmp_path):
    put_transfer(tmp_path, "mops", 32, 0.8)
    put_transfer(tmp_path, "mops", 8, 0.4, nets={"dgcnn seed 0": ("aaaa", 0.5)})
    (row,) = [row for row in second(table(tmp_path)) if row[:2] == ["8", "mops"]]
    assert row[3:] == ["20.00 / 20.00", ""]


def test_transfer_grid_one_label_of_two_nets_raises(tmp_path):
    put_transfer(tmp_path, "mops", 32, 0.8)
    put_transfer(tmp_path, "mops", 8, 0.4, nets={"dgcnn seed 0": ("cccc", 0.5)})
    with pytest.raises(UserError, match=r"differ in the weights of dgcnn seed 0.*aaaa, cccc"):
        table(tmp_path)


def test_records_without_task_nets_have_no_transfer_table(tmp_path):
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8})
    assert "had no part in the training" not in table(tmp_path)


def test_transfer_is_in_all_files(tmp_path):
    put_transfer(tmp_path, "mops", 32, 0.8)
    write(build(tmp_path), tmp_path)
    assert r"32 & mops & 80.00 / 80.00 & 40.00 / 40.00" in (tmp_path / "table.tex").read_text()
    with (tmp_path / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    values = {line["net"]: line["value"] for line in lines if line["readout"] == "matched"}
    assert values == {
        "pointnet": "0.8",
        "dgcnn seed 0": "0.4",
        "pointnet seed 1": "0.7200000000000001",
    }
