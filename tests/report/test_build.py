import pytest

from mops_lightning.report import paper
from mops_lightning.report.build import build_report
from tests.support.records import NAMES, evaluated
from tests.support.reports import put, put_cell, put_pairs, rows, table


def test_build_shows_records_and_paper(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3, "test/full/accuracy": 0.9})
    put(tmp_path, "fps", 8, {"test/sampled/accuracy": 0.1})
    learned = {"test/generated/accuracy": 0.8, "test/matched/accuracy": 0.77}
    put(tmp_path, "mops", 32, {**learned, "test/random/accuracy": 0.2, "val/x/accuracy": 1.0})
    assert rows(table(tmp_path)) == [
        ["sampled by", "m=32", "m=8"],
        ["random", "20.00", ""],
        ["*the paper's*", "15.07", "4.70"],
        ["fps", "30.00", "10.00"],
        ["*the paper's*", "34.08", "11.02"],
        ["mops", "80.00 / 77.00", ""],
        ["*the paper's*", "84.28 / 79.01 / 79.74", "52.39 / 32.62 / 32.62"],
    ]
    assert "pointnet on all points: 90.00 (the paper: 87.10)." in table(tmp_path)


def test_build_with_costs_has_an_empty_cell_of_costs_in_rows_of_the_paper(tmp_path):
    scores = {"test/sampled/accuracy": 0.3}
    put(tmp_path, "fps", 32, scores, seconds={"fit": 2000.0, "total": 2100.0})

    assert rows(table(tmp_path)) == [
        ["sampled by", "m=32", "training (wall)"],
        ["fps", "30.00", "2,000 s"],
        ["*the paper's*", "34.08", ""],
    ]


@pytest.mark.parametrize(
    "changed",
    [
        {"test_noise_std": 0.1},
        {"test_corruption": "shear-3"},
        {"names": {**NAMES, "dataset": "shapes", "sampler": "fps"}},
    ],
)
def test_build_other_test_clouds_show_no_paper(tmp_path, changed):
    metrics = {"test/sampled/accuracy": 0.3, "test/full/accuracy": 0.9}
    put(tmp_path / "the paper's", "fps", 32, metrics)
    put(tmp_path / "others", "fps", 32, metrics, config=changed)
    assert "paper" in table(tmp_path / "the paper's")
    assert "paper" not in table(tmp_path / "others")


def test_build_several_metrics_give_several_tables(tmp_path):
    metrics = {"test/sampled/nre_cd": 1.5, "test/sampled/nre_emd": 2.5}
    metrics |= {"test/full/nre_cd": 1.0, "test/full/chamfer": 0.0025, "test/full/emd": 0.06}
    put(tmp_path, "fps", 32, metrics, task="reconstruction")
    text = table(tmp_path, "nre_cd", "nre_emd")
    assert text.count("| sampled by |") == 2
    assert text.index("Test nre cd") < text.index("| fps | 1.5 |") < text.index("Test nre emd")
    assert text.count("seed 0") == 1
    assert "pointnet on all points: chamfer 0.0025." in text
    assert "pointnet on all points: emd 0.06." in text


def test_build_metric_of_one_task_gives_tables_of_this_task(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put_pairs(tmp_path, "fps", 32, 12.0)
    assert rows(table(tmp_path, "accuracy"))[1] == ["fps", "30.00"]
    assert table(tmp_path, "accuracy").count("| sampled by |") == 1


def test_build_registration_shows_degrees_and_icp_last(tmp_path):
    put_pairs(tmp_path, "fps", 32, 12.345)
    put_pairs(tmp_path, "fps", 32, 20.0, net="icp")
    put_pairs(tmp_path, "mops", 8, 9.0)
    text = table(tmp_path)
    assert text.startswith("Test rotation error (°): registration on modelnet40 under pcrnet;")
    assert rows(text) == [
        ["sampled by", "m=32", "m=8"],
        ["fps", "12.35", ""],
        ["*the paper's*", "13.12", "33.28"],
        ["mops", "", "9.00"],
        ["*the paper's*", "7.97 / 8.53 / 8.54", "12.64 / 12.68 / 12.68"],
        ["icp on fps", "20.00", ""],
    ]
    assert "pcrnet on all points: 7.50 (the paper: 7.21)." in text
    assert "icp on all points: 7.50." in text
    assert "The paper does not say whether its angles are geodesic" in text


def test_build_joint_registration_shows_paper_joint_table(tmp_path):
    joint = {"task_weights_sha256": None, "evaluated": evaluated(learn="joint")}
    put_pairs(tmp_path, "mops", 32, 6.0, **joint)
    assert ["*the paper's*", "6.74 / 9.18 / 9.65"] in rows(table(tmp_path))


def test_recipes_have_rows_of_their_own_with_the_papers_values(tmp_path):
    fast = {"recipe": {"name": "fast", "train_points": 256}}
    anchored = {**fast, "of": {"anchors": "fps"}}
    for value, changes in ((0.5, {}), (0.6, fast), (0.7, anchored)):
        put(tmp_path / f"{value}", "mops", 32, {"test/generated/accuracy": value}, **changes)
    paper = ["*the paper's*", "84.28 / 79.01 / 79.74"]
    found = rows(table(tmp_path))
    assert found[1:3] == [["mops", "50.00"], paper]
    assert found[3:] == [["mops anchored fast", "70.00"], paper, ["mops fast", "60.00"], paper]


def test_provenance_several_ways_name_runs(tmp_path):
    values = {"generated": 1.0, "matched": 1.5}
    for name, m, length in (("short-8", 8, 3), ("short-16", 16, 3), ("long", 32, 9)):
        put_cell(tmp_path, name, "mops", values, m=m, trainer={"max_epochs": length})
    put_cell(tmp_path, "other", "samplenet", values, m=8, trainer={"max_epochs": 9})
    text = table(tmp_path, mixed=True)
    assert "- mops (short-16, short-8): 3 epochs, seed 0" in text
    assert "- mops (long): 9 epochs, seed 0" in text
    assert "- samplenet: 9 epochs, seed 0" in text


def test_provenance_hides_other_tasks_and_names_other_nets(tmp_path):
    put_pairs(tmp_path, "fps", 32, 12.0)
    put_pairs(tmp_path, "fps", 32, 20.0, net="icp")
    put(tmp_path, "snet", 32, {"test/full/accuracy": 0.9}, config={"learn": "task"})
    text = table(tmp_path)
    assert "pointnet" not in text
    assert "- fps under icp: nothing to train" in text
    assert "- fps: nothing to train" in text


SIZES = {
    "classification": {"512", "256", "128", "64", "32", "16", "8"},
    "registration": {"64", "32", "8"},
    "registration_joint": {"64", "32", "8"},
    "large_nre_cd": {"4096", "1024", "256"},
    "large_nre_emd": {"4096", "1024", "256"},
}


@pytest.mark.parametrize("name", SIZES)
def test_published_tables_are_complete(name):
    assert set(paper.published_tables()) == {*SIZES, "frameworks"}
    for sampler, sizes in paper.published_tables()[name]["rows"].items():
        assert set(sizes) == SIZES[name]
        count = 1 if sampler in ("random", "voxel", "fps") or "large" in name else 3
        assert {len(values) for values in sizes.values()} == {count}


def test_remarks_name_all_hidden_and_collapsed_runs_and_count_groups_not_tables(tmp_path):
    collapsed = {"test/generated/accuracy": 0.5, "test/matched/unique_points": 3.0}
    for hour in (1, 2, 3):
        started = f"2026-01-01T0{hour}:00:00+00:00"
        put(tmp_path / f"{hour}", "mops", 32, collapsed, started=started, threads=2)
    for data in ("first", "second"):
        scores = {"test/sampled/accuracy": 0.3, "test/sampled/unique_points": 32.0}
        put(tmp_path / data, "fps", 32, scores, dataset_fingerprint=data, threads=2)

    report = build_report(tmp_path, ("accuracy", "unique_points"))

    assert len(report.grids) == 6
    hidden = "not shown; a later run has the same row, column and seed"
    made = "nothing to train, seed 0, cpu, 2 threads, commit 0123456789"
    assert report.remarks == [
        f"- mops: {made}",
        f"- fps: {made}",
        "- mops: collapsed: only 3.0 of 32 matched points are distinct. Use the completed set, "
        "whose points are distinct.",
        f"- {tmp_path}/1/mops-32-pointnet: {hidden}",
        f"- {tmp_path}/2/mops-32-pointnet: {hidden}",
        "",
        "3 groups of runs are not comparable and have tables of their own.",  # data differ
    ]
