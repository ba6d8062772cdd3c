from itertools import product

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.report.cells import Cells
from mops_lightning.report.windows import equal_ratios

PLANES = {"mops": ("sampler.alpha", "sampler.tau_min"), "samplenet": ("beta", "gamma")}


def planes(mops, samplenet):
    """Cells of two heat maps; every plane is given as (x values, y values, function)."""
    cells = Cells(MetricInfo("nre_cd"))
    for name, (xs, ys, value) in {"mops": mops, "samplenet": samplenet}.items():
        cells.values[name] = {
            place: {"generated": {0: value(*place)}, "matched": {0: 2.0}}
            for place in product(xs, ys)
        }
    return cells


def two_planes():
    return planes(
        ((0.1, 1.0, 10.0), (0.5, 0.9), lambda x, _: x**0.1),
        # Nothing changes below 1e-3, much above.
        ((1.0, 2.0), (1e-5, 1e-3, 1e-1), lambda _, y: max(y, 1e-3)),
    )


def compared(cells):
    grid = equal_ratios(cells, PLANES)
    assert grid is not None
    return grid


def test_equal_ratios_compares_windows():
    grid = compared(two_planes())
    assert "no setting changes by more than a factor of 100." in grid.title
    assert grid.head == ["window", "generated", "matched"]
    assert grid.rows == [
        ["samplenet, beta 1 to 2, gamma 1e-05 to 0.001", "1", "1"],
        ["samplenet, beta 1 to 2, gamma 0.001 to 0.1", "100", "1"],
        ["mops, alpha 0.1 to 10, tau_min 0.5 to 0.9", "1.58", "1"],
    ]
    counts = "in pairs of windows: generated 1 of 2, matched 0 of 2."
    assert grid.below == [
        f"samplenet varies less than mops {counts}",
        f"mops varies less than samplenet {counts}",
    ]


def test_equal_ratios_window_with_missing_run_is_left_out():
    cells = two_planes()
    del cells.values["samplenet"][2.0, 1e-1]
    rows = [row[0] for row in compared(cells).rows]
    assert len(rows) == 2
    assert "samplenet, beta 1 to 2, gamma 1e-05 to 0.001" in rows


def test_equal_ratios_needs_two_samplers_and_positive_numbers():
    cells = two_planes()
    assert equal_ratios(cells, {"mops": PLANES["mops"]}) is None
    cells.values["mops"][0.1, 0.5]["generated"] = {0: 0.0}
    assert equal_ratios(cells, PLANES) is None
    zero = planes(((0.0, 1.0), (0.5, 0.9), lambda x, y: 1.0), ((1.0,), (2.0,), lambda x, y: 1.0))
    assert equal_ratios(zero, PLANES) is None
