import sys

import pytest
import torch

from mops_lightning.ops.workers import number_of_threads


def test_number_of_threads_is_that_of_torch_where_it_is_imported(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)

    assert number_of_threads() == 3


@pytest.mark.parametrize(
    ("limit", "expected"),
    [
        ("7", 7),
        ("0", 5),
        ("many", 5),
        ("", 5),
    ],
)
def test_number_of_threads_without_torch_is_the_limit_or_that_of_processors(
    limit, expected, monkeypatch
):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setenv("OMP_NUM_THREADS", limit)
    monkeypatch.setattr("os.cpu_count", lambda: 5)

    assert number_of_threads() == expected
