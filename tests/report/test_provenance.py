"""The remarks below a report's tables."""

import pytest

from mops_lightning.report.collect import Found
from mops_lightning.report.provenance import collapses, provenance, without_result
from tests.support.records import evaluated, record


def test_collapses_name_each_kind_once_with_the_mean_over_seeds():
    seeds = [
        record(
            config={"m": 16, "sampler": {"overlap": 0.0}},
            metrics={"test/generated/accuracy": 0.75, "test/matched/unique_points": distinct},
        )
        for distinct in (2.0, 3.0)
    ]
    distinct = record(metrics={"test/matched/unique_points": 31.0})

    lines = collapses([*seeds, distinct], "pointnet")

    assert lines == [
        "- mops: collapsed: only 2.5 of 16 matched points are distinct. "
        "Try sampler.overlap=10 or sampler.anchors=fps (docs/samplers.md)."
    ]


def test_tags_of_a_run_are_shown_with_how_it_was_made():
    (line,) = provenance([record(config={"tags": ["first", "wide"]})], "pointnet")
    assert line.endswith(", tags first wide")


TRAINED = {"fit": 1.0, "total": 1.0}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"seconds": TRAINED, "threads": 1, "seed": 5},
            "- mops: 3 epochs, seed 5, cpu, 1 thread, commit 0123456789",
        ),
        (
            {"seconds": TRAINED, "config": {"trainer": {"max_epochs": 1}, "learn": "joint"}},
            "- mops, jointly trained: 1 epoch, seed 0, cpu, 2 threads, commit 0123456789",
        ),
        (
            {"seconds": TRAINED, "config": {"learn": "task"}},
            "- pointnet: 3 epochs, seed 0, cpu, 2 threads, commit 0123456789",
        ),
        (
            {"evaluated": evaluated(seed=7), "git": {"commit": "a" * 40, "dirty": True}},
            "- mops: evaluated after 9 epochs, seed 7, cpu, 2 threads, commit aaaaaaaaaa with "
            "changes",
        ),
        (
            {"device": "NVIDIA H100", "git": {"commit": None, "dirty": None}},
            "- mops: nothing to train, seed 0, NVIDIA H100, 2 threads, commit unknown",
        ),
    ],
)
def test_provenance_says_how_a_run_was_made(changes, line):
    assert provenance([record(**{"threads": 2, **changes})], "pointnet") == [line]


@pytest.mark.parametrize(("number", "are_named"), [(8, True), (9, False)])
def test_provenance_names_the_runs_of_a_way_up_to_eight(number, are_named):
    names = [f"run{place}" for place in range(number)]
    short = [record(folder=f"runs/{name}", seconds=TRAINED, threads=2) for name in names]
    long = record(folder="runs/long", seconds=TRAINED, threads=1)

    first, second = provenance([*short, long], "pointnet")

    named = f" ({', '.join(names)})" if are_named else ""
    assert first == f"- mops{named}: 3 epochs, seed 0, cpu, 2 threads, commit 0123456789"
    assert second == "- mops (long): 3 epochs, seed 0, cpu, 1 thread, commit 0123456789"


def test_provenance_of_an_evaluated_joint_training_does_not_say_that_it_trained():
    again = record(evaluated=evaluated(learn="joint", max_epochs=1), threads=2)

    assert provenance([again], "pointnet") == [
        "- mops: evaluated after 1 epoch, seed 0, cpu, 2 threads, commit 0123456789"
    ]


@pytest.mark.parametrize(
    ("undone", "head"),
    [
        ({"a": "failed"}, "1 of 3 runs has no full result:"),
        ({"a": "failed", "b": "running"}, "2 of 4 runs have no full result:"),
    ],
)
def test_without_result_counts_all_runs(undone, head):
    lines = without_result(Found([record(), record()], undone))

    assert lines == ["", head, "", *[f"- {run}: {why}" for run, why in undone.items()]]
