"""Which settings of runs give the columns of a table, and which give tables."""

import pytest

from tests.support.records import evaluated
from tests.support.reports import put, put_cell, rows, table


def test_settings_of_one_recipe_that_differ_give_columns(tmp_path):
    for points in (256, 512):
        recipe = {"name": "fast", "train_points": points}
        scores = {"test/generated/accuracy": points / 1000}
        put(tmp_path / f"{points}", "mops", 32, scores, recipe=recipe)

    assert rows(table(tmp_path))[:2] == [
        ["sampled by", "recipe.train_points=256", "recipe.train_points=512"],
        ["mops fast", "25.60", "51.20"],
    ]


@pytest.mark.parametrize(
    ("values", "heads"),
    [
        ((1, 2), [["optimizer.flag=1", "optimizer.flag=2"]]),
        ((1, 1.0), [["m=32"]]),
        ((False, True), [["m=32"], ["m=32"]]),
    ],
)
def test_numbers_give_columns_and_truth_values_tables(values, heads, tmp_path):
    for number, value in enumerate(values):
        scores = {"generated": 1.0 + number}
        put_cell(tmp_path, f"{number}", "mops", scores, seed=number, optimizer={"flag": value})

    found = [row[1:] for row in rows(table(tmp_path)) if row[0] == "sampled by"]

    of_settings = [[head for head in row if "=" in head] for row in found]
    assert of_settings == heads


def test_means_of_full_clouds_by_net_count_equal_figures_once(tmp_path):
    """Three runs of one data set, and one of another seed's."""
    for name, net, weights, full in (
        ("a", "pointnet", "run", 0.8),
        ("b", "dgcnn", "x", 0.5),
        ("c", "dgcnn", "x", 0.5),
        ("d", "dgcnn", "x", 0.7),
    ):
        metrics = {"test/generated/accuracy": 0.25, "test/full/accuracy": full}
        config = {"weights": weights}
        changes = {"evaluated": evaluated(), "task_weights_sha256": net}
        sampler = f"mops{name}"
        put(tmp_path / name, sampler, 32, metrics, net=net, config=config, **changes)

    *_, last = rows(table(tmp_path))

    assert last == ["", "all points", "80.00", "60.00"]
