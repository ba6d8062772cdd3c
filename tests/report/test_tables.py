import json

import pytest

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.report import paper
from mops_lightning.report.cli import main
from tests.support.records import record
from tests.support.reports import put, rows, table


def test_cells_are_the_records_figures_beside_the_paper_s(tmp_path):
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


def test_runs_of_many_sizes_fill_many_cells(tmp_path):
    metrics = {"test/full/accuracy": 0.9}
    for m in (8, 32):
        metrics |= {f"test/m{m}/{name}/accuracy": m / 100 for name in ("generated", "matched")}
        metrics |= {f"test/m{m}/fps/accuracy": m / 200, f"test/m{m}/matrix/nonzero_percent": 3.0}
    put(tmp_path, "fmops", 32, metrics)
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    ours = [row for row in rows(table(tmp_path)) if "paper" not in row[0]]
    assert ours == [
        ["sampled by", "m=32", "m=8"],
        ["fps", "30.00", "4.00"],  # a run of its own goes before a baseline's row
        ["fmops", "32.00 / 32.00", "8.00 / 8.00"],
    ]
    put(tmp_path, "fmops", 8, {"test/generated/accuracy": 0.8})
    with pytest.raises(UserError, match="Two runs of fmops with m=8 and seed=0"):
        table(tmp_path)


def test_runs_that_are_not_completed_are_counted_not_shown(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8}, status="interrupted")
    text = table(tmp_path)
    assert "80.00" not in text
    assert "1 of 2 runs are not completed" in text


@pytest.mark.parametrize("note", ["dataset_fingerprint", "task_weights_sha256"])
def test_runs_of_other_data_or_weights_are_not_mixed(tmp_path, note):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8}, notes={note: "other"})
    with pytest.raises(UserError, match="differ in"):
        table(tmp_path)


def test_two_runs_for_one_cell_are_refused(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        put(tmp_path / name, "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match="Two runs of fps with m=32"):
        table(tmp_path)


def test_joint_runs_stand_apart_each_with_its_own_task_net(tmp_path):
    for name in ("snet", "mops"):
        metrics = {"test/generated/accuracy": 0.5, "test/fps/accuracy": 0.2}
        notes = {"task_weights_sha256": name, "evaluated": {"learn": "joint", "max_epochs": 9}}
        put(tmp_path, name, 32, {**metrics, "test/full/accuracy": 0.9}, notes=notes)
    text = table(tmp_path)
    assert [row[0] for row in rows(text) if "paper" not in row[0]] == ["sampled by", "snet", "mops"]
    assert "pointnet on all points after joint training with snet: 90.00" in text
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match="differ in what learned"):
        table(tmp_path)


def test_an_unknown_metric_and_unreadable_records_are_named(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match=r"--metric: no run has 'acuracy'.*accuracy"):
        table(tmp_path, "acuracy")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "result.json").write_text("")
    assert f"- {tmp_path}/bad: not readable" in table(tmp_path)


def test_the_paper_s_figures_stand_by_its_own_data_only(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    path = tmp_path / "fps-32-pointnet" / "result.json"
    path.write_text(path.read_text().replace("modelnet40", "shapes"))
    assert "paper" not in table(tmp_path)


def test_a_folder_without_records_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path)])
    assert stop.value.code == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_the_command_writes_what_it_prints(tmp_path, capsys):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    main([str(tmp_path)])
    text = (tmp_path / "table.md").read_text()
    assert text in capsys.readouterr().out


DEGREES = "rotation_error_deg"


def put_pairs(folder, sampler, m, value, net="pcrnet", rotation=45, **changes):
    changes["notes"] = {"score": f"test/sampled/{DEGREES}", **changes.get("notes", {})}
    metrics = {f"test/sampled/{DEGREES}": value, f"test/full/{DEGREES}": 7.5}
    pairs = {"pairs": {"rotation": rotation}}
    put(folder, sampler, m, metrics, "registration", net, settings=pairs, **changes)
    if net == "icp":  # there are no weights to note
        path = folder / f"{sampler}-{m}-icp" / "result.json"
        content = json.loads(path.read_text())
        del content["notes"]["task_weights_sha256"]
        path.write_text(json.dumps(content))


def test_registration_is_shown_in_degrees_with_icp_below(tmp_path):
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


def test_pairs_made_in_different_ways_are_not_mixed(tmp_path):
    put_pairs(tmp_path, "fps", 32, 12.0)
    put_pairs(tmp_path, "mops", 32, 9.0, rotation=30)
    with pytest.raises(UserError, match=r"differ in pairs"):
        table(tmp_path)


def test_nets_of_other_settings_are_not_mixed(tmp_path):
    for name, passes in (("fps", 1), ("mops", 3)):
        put(
            tmp_path,
            name,
            32,
            {"test/sampled/accuracy": 0.5},
            settings={"net": {"iterations": passes}},
        )
    with pytest.raises(UserError, match=r"differ in settings of pointnet"):
        table(tmp_path)


def put_net(folder, name, metrics, task, net="pcrnet", points=1024, **settings):
    target = folder / f"{name}-{points}"
    target.mkdir()
    metrics = {f"test/full/{metric}": value for metric, value in metrics.items()}
    config = {
        "learn": "task",
        "names": {"task": task, "net": net, "dataset": "modelnet40"},
        "trainer": {"max_epochs": 3},
        "task": {"net": {"_target_": net, "n_points": points, **settings}},
        "dataset": {"n_points": points},
    }
    notes = {"score": next(iter(metrics)), "parameters": {"task": 1_025_000}}
    return run_record.write(target, record(config=config, metrics=metrics, notes=notes))


def test_a_folder_of_task_nets_alone_is_a_table_of_nets(tmp_path):
    put_net(tmp_path, "first", {DEGREES: 7.5}, "registration", iterations=1)
    put_net(tmp_path, "second", {DEGREES: 6.5}, "registration", iterations=8)
    text = table(tmp_path)
    assert text.startswith("No sampler was tested; registration on modelnet40 from all points.")
    assert rows(text) == [
        ["net", "iterations", "points", "rotation error (°)", "MB", "*the paper's*"],
        ["pcrnet", "1", "1024", "7.50", "4.1", "7.21"],
        ["pcrnet", "8", "1024", "6.50", "4.1", "7.21"],
    ]
    with pytest.raises(UserError, match=r"--metric: no run has 'chamfr'"):
        table(tmp_path, "chamfr")
    path = put_net(tmp_path, "third", {DEGREES: 6.0}, "registration", iterations=8)
    with pytest.raises(UserError, match="Two runs of registration by the same net and seed"):
        table(tmp_path)
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "seed": 1}))
    assert rows(table(tmp_path))[2][3] == "6.25 ± 0.35 (n=2)"
    content["config"]["batch_size"] = 7
    path.write_text(json.dumps({**content, "seed": 1}))
    with pytest.raises(UserError, match=r"differ in their settings \(batch_size\).*--mixed"):
        table(tmp_path)
    assert rows(table(tmp_path, mixed=True))[2][3] == "6.25 ± 0.35 (n=2)"
    put_net(tmp_path, "fourth", {"accuracy": 0.5}, "classification", "pointnet")
    with pytest.raises(UserError, match="differ in task: classification, registration"):
        table(tmp_path)


def test_nets_that_reconstruct_stand_beside_the_paper_s(tmp_path):
    distances = {"nre_cd": 1.0, "chamfer": 0.00123, "emd": 0.05}
    for points in (10000, 1024):
        for pieces in (16, 1, 8):
            net = "mfoldingnet" if pieces > 1 else "foldingnet"
            given = ("reconstruction", net, points)
            put_net(tmp_path, f"m{pieces}", distances, *given, pieces=pieces, encoder="mlp")
    put_net(tmp_path, "mlp", distances, "reconstruction", "autoencoder")
    found = rows(table(tmp_path))
    assert found[0] == ["net", "pieces", "points", "chamfer", "emd", "MB", "*the paper's*"]
    assert [row[:3] for row in found[1:]] == [
        ["autoencoder", "", "1024"],
        ["foldingnet", "1", "1024"],
        ["mfoldingnet", "8", "1024"],
        ["mfoldingnet", "16", "1024"],
        ["foldingnet", "1", "10000"],
        ["mfoldingnet", "8", "10000"],
        ["mfoldingnet", "16", "10000"],
    ]
    assert found[3][3:] == ["0.00123", "0.05", "4.1", "12.69 / 209.13 / 2.9"]
    assert found[5][-1] == "1.25 / 18.8 / 12"


def test_several_metrics_make_several_tables(tmp_path):
    metrics = {"test/sampled/nre_cd": 1.5, "test/sampled/nre_emd": 2.5}
    metrics |= {"test/full/nre_cd": 1.0, "test/full/chamfer": 0.0025, "test/full/emd": 0.06}
    put(tmp_path, "fps", 32, metrics, task="reconstruction")
    text = table(tmp_path, "nre_cd", "nre_emd")
    assert text.count("| sampled by |") == 2
    assert text.index("Test nre cd") < text.index("| fps | 1.5 |") < text.index("Test nre emd")
    assert text.count("seed 0") == 1
    assert "pointnet on all points: chamfer 0.0025." in text
    assert "pointnet on all points: emd 0.06." in text


def test_runs_of_another_task_are_not_listed_and_other_nets_are_named(tmp_path):
    put_pairs(tmp_path, "fps", 32, 12.0)
    put_pairs(tmp_path, "fps", 32, 20.0, net="icp")
    put(tmp_path, "snet", 32, {"test/full/accuracy": 0.9})
    path = tmp_path / "snet-32-pointnet" / "result.json"
    path.write_text(path.read_text().replace('"learn": "sampler"', '"learn": "task"'))
    text = table(tmp_path)
    assert "pointnet" not in text
    assert "- fps under icp: nothing to train" in text
    assert "- fps: nothing to train" in text


def test_joint_registration_stands_by_the_paper_s_joint_table(tmp_path):
    notes = {"task_weights_sha256": None, "evaluated": {"learn": "joint", "max_epochs": 9}}
    put_pairs(tmp_path, "mops", 32, 6.0, notes=notes)
    assert ["*the paper's*", "6.74 / 9.18 / 9.65"] in rows(table(tmp_path))


SIZES = {
    "classification": {"512", "256", "128", "64", "32", "16", "8"},
    "registration": {"64", "32", "8"},
    "registration_joint": {"64", "32", "8"},
    "large_nre_cd": {"4096", "1024", "256"},
    "large_nre_emd": {"4096", "1024", "256"},
}


@pytest.mark.parametrize("name", SIZES)
def test_paper_figures_are_complete(name):
    assert set(paper.tables()) == {*SIZES, "frameworks"}
    for sampler, sizes in paper.tables()[name]["rows"].items():
        assert set(sizes) == SIZES[name]
        count = 1 if sampler in ("random", "voxel", "fps") or "large" in name else 3
        assert {len(values) for values in sizes.values()} == {count}
