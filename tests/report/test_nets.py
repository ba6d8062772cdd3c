import json

import pytest

from mops_lightning.errors import UserError
from tests.support.reports import DEGREES, edited, put, put_net, rows, table


def test_nets_grid_has_row_per_net(tmp_path):
    put_net(tmp_path, "first", {DEGREES: 7.5}, "registration", iterations=1)
    put_net(tmp_path, "second", {DEGREES: 6.5}, "registration", iterations=8)

    text = table(tmp_path)

    assert text.startswith("No sampler was tested; registration on modelnet40 from all points.")
    assert rows(text) == [
        ["net", "iterations", "points", "rotation error (°)", "MB", "*the paper's*"],
        ["pcrnet", "1", "1024", "7.50", "4.1", "7.21"],
        ["pcrnet", "8", "1024", "6.50", "4.1", "7.21"],
    ]


def test_unknown_metric_is_refused(tmp_path):
    put_net(tmp_path / "nets", "first", {DEGREES: 7.5}, "registration", iterations=1)
    put(tmp_path / "samplers", "fps", 32, {"test/sampled/accuracy": 0.3})
    with pytest.raises(UserError, match=r"--metric: no run has 'chamfr'"):
        table(tmp_path / "nets", "chamfr")
    with pytest.raises(UserError, match=r"--metric: no run has 'acuracy'.*accuracy"):
        table(tmp_path / "samplers", "acuracy")


def test_nets_grid_of_two_seeds_shows_mean_and_deviation(tmp_path):
    put_net(tmp_path, "first", {DEGREES: 6.5}, "registration")
    path = put_net(tmp_path, "second", {DEGREES: 6.0}, "registration")
    edited(path, started="2026-01-02T00:00:00+00:00")
    _, line = rows(table(tmp_path))
    assert line[2] == "6.00", "the later run of a seed counts"

    edited(path, seed=1)

    _, line = rows(table(tmp_path))
    assert line[2] == "6.25 ± 0.35 (n=2)"


def test_nets_of_differing_settings_share_a_table_if_mixed(tmp_path):
    put_net(tmp_path, "first", {DEGREES: 6.5}, "registration", iterations=1)
    path = put_net(tmp_path, "second", {DEGREES: 6.0}, "registration", iterations=8)
    config = json.loads(path.read_text())["config"]
    edited(path, config={**config, "batch_size": 7})
    put_net(tmp_path, "third", {DEGREES: 6.2}, "registration", iterations=8)

    apart = table(tmp_path)
    together = table(tmp_path, mixed=True)

    assert apart.count("No sampler was tested") == 2
    assert "(batch_size=7)" in apart
    _, *lines = rows(together)
    assert [line[4] for line in lines] == ["6.00", "6.50", "6.20"]


def test_nets_of_two_tasks_have_tables_of_their_own(tmp_path):
    put_net(tmp_path, "first", {DEGREES: 7.5}, "registration")
    put_net(tmp_path, "second", {"accuracy": 0.5}, "classification", "pointnet")

    text = table(tmp_path)

    metrics = [row[2] for row in rows(text) if row[0] == "net"]
    assert metrics == ["rotation error (°)", "accuracy (%)"]


def test_nets_grid_reconstruction_shows_paper(tmp_path):
    distances = {"nre_cd": 1.0, "chamfer": 0.00123, "emd": 0.05}
    nets = {16: "mfoldingnet", 1: "foldingnet", 8: "mfoldingnet"}
    for points in (10000, 1024):
        for pieces, net in nets.items():
            given = ("reconstruction", net, points)
            put_net(tmp_path, f"m{pieces}", distances, *given, pieces=pieces)
    put_net(tmp_path, "mlp", distances, "reconstruction", "autoencoder")

    found = rows(table(tmp_path))

    head, *lines = found
    assert head == ["net", "pieces", "points", "chamfer", "emd", "MB", "*the paper's*"]
    assert [line[:3] for line in lines] == [
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


def test_nets_grid_names_samplers_inside_and_shows_no_figure_of_another_net(tmp_path):
    fps = "mops_lightning.samplers.fps.FPSSampler"
    mops = "mops_lightning.samplers.mops.MOPSNet"
    samplers = {
        "fps": {"_target_": fps, "m": 16},
        "free": {"_target_": mops, "m": 16, "anchors": None},
        "anchored": {"_target_": mops, "m": 16, "anchors": "fps"},
    }
    for name, sampler in samplers.items():
        given = (tmp_path, name, {"accuracy": 0.5}, "classification", "hierarchical")
        put_net(*given, sampler=sampler)

    assert rows(table(tmp_path)) == [
        ["net", "sampler", "sampler.anchors", "points", "accuracy (%)", "MB"],
        ["hierarchical", "fps", "", "1024", "50.00", "4.1"],
        ["hierarchical", "mops", "fps", "1024", "50.00", "4.1"],
        ["hierarchical", "mops", "none", "1024", "50.00", "4.1"],
    ]


def test_nets_grid_shows_mean_times_sizes_and_changed_checkouts(tmp_path):
    for seed, seconds in ((0, 1000.0), (1, 2000.4)):
        path = put_net(tmp_path, f"{seed}", {"accuracy": 0.5}, "classification", "pointnet")
        git = {"commit": "c" * 40, "dirty": seed == 1}
        times = {"total": 9000.0, "fit": seconds}
        edited(path, seed=seed, seconds=times, parameters={"task": 2_500_000}, git=git)

    text = table(tmp_path)

    assert rows(text) == [
        ["net", "points", "accuracy (%)", "MB", "training (wall)", "*the paper's*"],
        ["pointnet", "1024", "50.00 ± 0.00 (n=2) †", "10.0", "1,500 s", "87.10"],
    ]
    assert "† With a run whose checkout had changes that no commit has." in text


def test_nets_grid_shows_requested_metrics_in_their_order(tmp_path):
    distances = {"nre_cd": 1.0, "chamfer": 0.5, "emd": 0.25}
    put_net(tmp_path, "mlp", distances, "reconstruction", "autoencoder")

    head, line = rows(table(tmp_path, "nre_cd", "emd"))

    assert head[2:4] == ["nre cd", "emd"]
    assert line[2:4] == ["1", "0.25"]


def test_nets_of_one_size_are_sorted_by_numbers_not_texts(tmp_path):
    for width in (16, 128, 8):
        given = ("classification", "pointnet")
        put_net(tmp_path, f"{width}", {"accuracy": width / 1000}, *given, width=width)

    _, *lines = rows(table(tmp_path))

    assert [line[1] for line in lines] == ["8", "16", "128"]
