"""The remarks below a report's tables."""

from mops_lightning.report.provenance import collapses, provenance
from tests.support.records import record


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
