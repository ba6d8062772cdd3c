import pytest

from mops_lightning.records.readout_names import ROWS, parse_metric_name, size_prefix

NAMES = {
    "test/generated/accuracy": (None, "generated", "accuracy"),
    "test/m32/generated/accuracy": (32, "generated", "accuracy"),
    "test/m8/mine/accuracy": (8, "mine", "accuracy"),
    "test/m8/accuracy": (None, "m8", "accuracy"),
    "test/full/emd": (None, "full", "emd"),
    "val/generated/accuracy": None,
    "train/generated/accuracy": None,
    "test/loss/cross_entropy": None,
    "test/m32/loss/cross_entropy": None,
    "test/matrix/nonzero_percent": None,
    "test/m32/matrix/nonzero_percent": None,
    "test/accuracy": None,
    "test/x32/generated/accuracy": None,
    "test/m/generated/accuracy": None,
    "": None,
}
"""Log keys, and their size, readout and metric."""


@pytest.mark.parametrize(("name", "parts"), NAMES.items())
def test_parse_metric_name_splits_names_of_tested_sets_only(name, parts):
    assert parse_metric_name(name) == parts


@pytest.mark.parametrize(("m", "prefix"), [(None, ""), (32, "m32/")])
def test_size_prefix_is_the_first_part_of_a_log_key(m, prefix):
    assert size_prefix(m) == prefix


def test_rows_of_readouts_are_in_the_order_of_tables():
    assert ROWS == ("generated", "matched", "completed", "projected", "sampled", "full")
