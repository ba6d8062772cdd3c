from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console
from torchmetrics.aggregation import SumMetric

from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.records.metric_info import foreign_metrics, metric_info
from mops_lightning.records.summary import closing_lines
from tests.support.records import NAMES, record


def printed(metrics, score, infos=None, **config):
    console = Console(width=80, record=True, file=StringIO())
    facts = {"score_name": score, "metric_info": infos or {}}
    closing_lines(Path("run"), record(config=config, metrics=metrics, **facts), console)
    return console.export_text()


def cells(text):
    lines = [line for line in text.splitlines() if line.startswith(("│", "┃"))]
    return [[cell.strip() for cell in line[1:-1].replace("┃", "│").split("│")] for line in lines]


def test_one_size_gives_column_per_metric_and_rows_of_baselines_readouts_full():
    accuracies = {"full": 0.875, "matched": 0.625, "fps": 0.25, "generated": 0.5}
    accuracies["random"] = 0.125
    metrics = {f"test/{readout}/accuracy": value for readout, value in accuracies.items()}
    metrics |= {"test/generated/subset_distance": 0.1, "test/completed/unique_points": 32.0}
    metrics |= {"test/matrix/nonzero_percent": 3.0, "test/loss/cross_entropy": 1.0}
    text = printed(metrics, "test/generated/accuracy")
    assert "m=32" in text
    assert cells(text) == [
        ["sampled by", "accuracy (%)"],
        ["fps", "25.00"],
        ["random", "12.50"],
        ["mops generated", "50.00"],
        ["mops matched", "62.50"],
        ["all points", "87.50"],
    ]


def test_columns_follow_declared_order_then_names_and_hide_the_rest():
    metrics = {}
    for readout in ("generated", "full"):
        for name in "dabc":
            metrics[f"test/{readout}/{name}"] = 1.5
    infos = {"a": {"summary_order": 2}, "b": {"summary_order": None}, "c": {"summary_order": 1}}
    infos["d"] = {"summary_order": 2}
    text = printed(metrics, "test/generated/c", infos)
    assert cells(text)[0] == ["sampled by", "c", "a", "d"]


def test_last_line_has_status_time_what_was_left_out_and_files():
    console = Console(width=80, record=True, file=StringIO())
    finished = record(
        seconds={"total": 61.6},
        partial=["tested on 1 of 4 batches", "trained on 1 of 9"],
        files={"weights": "z.safetensors", "clouds": "clouds.npz"},
        metrics={},
    )

    closing_lines(Path("run"), finished, console)

    assert console.export_text() == (
        "completed in 62 s, but tested on 1 of 4 batches and trained on 1 of 9; files in run/: "
        "result.json, clouds.npz, z.safetensors\n"
    )


def test_seven_sizes_fit_eighty_columns():
    metrics = {"test/full/accuracy": 0.875, "test/full/mean_class_accuracy": 0.8}
    sizes = (8, 16, 32, 64, 128, 256, 512)
    for m in sizes:
        metrics[f"test/m{m}/completed/accuracy"] = m / 1000
        metrics[f"test/m{m}/completed/mean_class_accuracy"] = m / 2000
    text = printed(metrics, "test/m32/generated/accuracy")
    assert "accuracy (%)" in text
    assert cells(text) == [
        ["sampled by", *(f"m={m}" for m in sizes)],
        ["mops completed", *(f"{m / 10:.2f}" for m in sizes)],
        ["all points", *["87.50"] * 7],
    ]


def test_task_net_alone_has_no_size():
    corrupted = {"learn": "task", "test_corruption": "shear-3", "test_noise_std": 0.0}
    text = printed({"test/full/accuracy": 0.5}, "test/full/accuracy", **corrupted)
    assert "all points, test, test_corruption=shear-3" in text
    assert "m=32" not in text
    assert "noise" not in text


def test_sampler_with_anchors_is_named_as_in_reports():
    metrics = {"test/generated/accuracy": 0.5, "test/full/accuracy": 0.875}
    text = printed(metrics, "test/generated/accuracy", sampler={"anchors": "fps"})
    assert cells(text)[1] == ["mops anchored generated", "50.00"]


def test_fps_names_its_start():
    """The baseline of a run and a run of FPS may start from other points."""
    metrics = {"test/generated/accuracy": 0.5, "test/full/accuracy": 1.0}
    for name in ("fps", "fps_farthest"):
        farthest = {name: {"start": "farthest"}}
        scores = {f"test/{name}/accuracy": 0.25, **metrics}
        text = printed(scores, "test/generated/accuracy", baselines=farthest)
        assert cells(text)[1] == ["fps from farthest", "25.00"]
    names = {**NAMES, "sampler": "fps"}
    metrics = {"test/sampled/accuracy": 0.5, "test/full/accuracy": 0.875}
    text = printed(metrics, "test/sampled/accuracy", names=names, sampler={"start": 0})
    assert cells(text)[1] == ["fps from row 0 sampled", "50.00"]


def test_plain_torchmetrics_class_gets_defaults():
    """Even under the name of a metric of this package."""
    assert foreign_metrics(collection(Accuracy(3)).items()) == {}
    foreign = foreign_metrics([("accuracy", SumMetric())])
    info = metric_info("accuracy", [record(metric_info=foreign)])
    assert (info.title, info.format(0.5), info.summary_order) == ("accuracy", "0.5", 10)


def test_collapsed_sampler_shows_its_distinct_points_beside_the_score():
    metrics = {
        "test/fps/accuracy": 0.25,
        "test/generated/accuracy": 0.75,
        "test/matched/accuracy": 0.5,
        "test/completed/accuracy": 0.25,
        "test/full/accuracy": 0.75,
        "test/matched/unique_points": 2.25,
    }

    text = printed(metrics, "test/generated/accuracy", m=16, sampler={"overlap": 0.0})

    assert cells(text) == [
        ["sampled by", "accuracy (%)", "distinct points"],
        ["fps", "25.00", ""],
        ["mops generated", "75.00", "2.2"],
        ["mops matched", "50.00", "2.2"],
        ["mops completed", "25.00", ""],
        ["all points", "75.00", ""],
    ]
    said = "collapsed: only 2.2 of 16 matched points are distinct. Try sampler.overlap=10"
    assert said in " ".join(text.split())


def test_collapse_at_one_size_shows_the_distinct_points_of_all():
    metrics = {"test/full/accuracy": 1.0}
    for m, distinct in ((8, 7.5), (32, 15.5)):
        metrics[f"test/m{m}/generated/accuracy"] = 0.5
        metrics[f"test/m{m}/matched/unique_points"] = distinct

    text = printed(metrics, "test/m32/generated/accuracy")

    assert cells(text)[-1] == ["distinct points", "7.5", "15.5"]
    said = "collapsed: only 15.5 of 32 matched points are distinct. Use the completed set"
    assert said in " ".join(text.split())


def test_sampler_with_half_of_its_points_distinct_has_not_collapsed():
    metrics = {"test/full/accuracy": 1.0, "test/generated/accuracy": 0.5}
    text = printed({**metrics, "test/matched/unique_points": 16.0}, "test/generated/accuracy")
    assert "distinct" not in text


def test_run_on_own_files_ends_in_the_methods_to_use():
    errors = {
        8: {"fps": 2.0, "fps_farthest": 2.1, "completed": 1.8, "generated": 1.7, "random": 5.0},
        32: {"fps": 1.2, "fps_farthest": 1.0, "completed": 1.005, "generated": 0.9, "random": 2.0},
    }
    metrics = {"test/full/nre_cd": 1.0}
    for m, by_readout in errors.items():
        for readout, error in by_readout.items():
            metrics[f"test/m{m}/{readout}/nre_cd"] = error
    of_files = {**NAMES, "task": "reconstruction", "dataset": "clouds"}

    text = printed(metrics, "test/m32/generated/nre_cd", names=of_files)
    other = printed(metrics, "test/m32/generated/nre_cd", names={**of_files, "dataset": "shapes"})

    said = (
        "Use FPS from the farthest point from 32 points on; your sampler is 10 % better at 8 "
        "(one draw).\n"
    )
    assert said in text
    assert "Use FPS" not in other


def test_run_of_a_sampler_that_chooses_input_points_ends_in_the_methods_to_use():
    of_files = {**NAMES, "task": "icp", "dataset": "clouds"}
    metrics: dict[str, float | None] = {"test/full/median_rotation_error_deg": 1.0}
    for m, sampled in ((16, 3.0), (32, 2.5)):
        metrics[f"test/m{m}/sampled/median_rotation_error_deg"] = sampled
        metrics[f"test/m{m}/fps_farthest/median_rotation_error_deg"] = 4.0
        metrics[f"test/m{m}/random/median_rotation_error_deg"] = None  # it was not finite

    text = printed(metrics, "test/m32/sampled/median_rotation_error_deg", names=of_files)

    assert (
        "Use your sampler for 16 to 32 points; your sampler is 25 % better than FPS at 16 and 38 % "
        "at 32 (one draw).\n"
    ) in text


def test_run_of_registration_without_a_trained_sampler_ends_without_advice():
    of_pairs = {**NAMES, "task": "registration"}
    metrics = {"test/sampled/rotation_error_deg": 9.0, "test/full/rotation_error_deg": 3.0}

    text = printed(metrics, "test/sampled/rotation_error_deg", names=of_pairs)

    assert "Use" not in text


class Accurate(SumMetric):
    """A user's metric under the name of one of this package."""

    name = "accuracy"


@pytest.mark.parametrize(
    ("name", "metric", "is_described"),
    [
        ("accuracy", Accuracy(3), False),
        ("exactness", Accuracy(3), True),
        ("accuracy", Accurate(), True),
    ],
)
def test_metrics_of_other_names_or_classes_are_described_in_the_record(name, metric, is_described):
    assert (name in foreign_metrics([(name, metric)])) == is_described


def test_title_of_a_task_net_alone_names_its_points_and_the_noise():
    metrics = {"test/full/accuracy": 0.5}
    text = printed(metrics, "test/full/accuracy", learn="task", test_noise_std=0.1)
    assert "classification by pointnet, shapes, all points, test, test_noise_std=0.1\n" in text
