from collections.abc import Sequence
from typing import Any, Literal

import pytest
from torch import Tensor

from mops_lightning.config.annotations import misfit


@pytest.mark.parametrize(
    ("annotation", "fitting", "misfitting", "wanted"),
    [
        (int, [3, -1], [1.5, True, None, "3", [3]], "a whole number"),
        (float, [3, 0.5], [True, None, "x"], "a number"),
        (bool, [True], [1, None, "true"], "true or false"),
        (str, ["x"], [3, None], "a text"),
        (int | None, [3, None], [1.5, "x"], "a whole number or null"),
        (float | Tensor, [0.1, 3], ["x"], "a number"),
        (Sequence[int], [[1, 2], []], [3, [1.5], ["a"], None], "a list of whole numbers"),
        (list[str] | None, [["a"], None], ["a", [3]], "a list of strings or null"),
        (tuple[float, float], [[0.9, 0.99]], [0.9], "a list of numbers"),
        (Literal["sum", "mean"], ["sum", "typo"], [3, None], "sum or mean"),
        (Any, [3, None, "x", [1]], [], ""),
    ],
)
def test_values_are_compared_with_annotations(annotation, fitting, misfitting, wanted):
    assert [misfit(value, annotation) for value in fitting] == [None] * len(fitting)
    assert [misfit(value, annotation) for value in misfitting] == [wanted] * len(misfitting)
