import itertools
from typing import Any

import pytest
from matplotlib.colors import LogNorm, Normalize

from mops_lightning.report.build import build_report
from mops_lightning.report.plots import plots
from tests.support.reports import put, put_cell


@pytest.mark.parametrize(
    ("far", "kind", "label"),
    [
        (3.0, Normalize, "3"),
        (12000.0, LogNorm, "12,000"),
    ],
)
def test_heat_maps_have_a_colour_scale_per_sampler(far, kind, label, tmp_path):
    for down, across in itertools.product((1, 2), (1, 2)):
        name = f"{down}{across}"
        values = {"generated": 1.0 + across, "matched": 2.0}
        settings = {"alpha": down, "tau": across}
        put_cell(tmp_path, f"mops{name}", "mops", values, of=settings)
        if name == "22":
            values["generated"] = far
        settings = {"beta": down, "gamma": across}
        put_cell(tmp_path, f"samplenet{name}", "samplenet", values, of=settings)

    figure = plots(build_report(tmp_path))["nre_cd_planes"]

    scales = {}
    labels: list[str] = []
    for axes in figure.axes:
        labels.extend(text.get_text() for text in axes.texts)
        if axes.images:
            scales[axes.get_title()] = axes.images[0].norm
    of_samplenet = scales["samplenet, generated"]
    of_mops = scales["mops, generated"]
    assert type(of_samplenet) is kind
    assert of_samplenet.vmax == far
    assert scales["samplenet, matched"] is of_samplenet
    assert type(of_mops) is Normalize
    assert of_mops.vmax == 3.0
    assert label in labels


def test_curves_show_values_by_size(tmp_path):
    for m in (8, 32):
        put(tmp_path, "fps", m, {"test/sampled/accuracy": m / 100})
        put(tmp_path, "mops", m, {"test/generated/accuracy": m / 50, "test/matched/accuracy": 0.5})

    (figure,) = plots(build_report(tmp_path)).values()

    generated, matched, completed = figure.axes
    assert curves_of(generated) == [[8, 32], [16, 64]]  # FPS, MOPS-Net
    assert curves_of(matched) == [[8, 32], [50, 50]]
    assert curves_of(completed) == [[8, 32]]  # no run has completed sets of MOPS-Net
    grids = [axes.xaxis.get_gridlines()[0].get_visible() for axes in figure.axes]
    assert grids == [True, True, True]


def curves_of(axes: Any) -> list[list[float]]:
    """The heights of all curves of a panel."""
    return [container.lines[0].get_ydata().tolist() for container in axes.containers]


def styles_of(axes: Any) -> list[str]:
    """The line styles of all curves of a panel."""
    return [container.lines[0].get_linestyle() for container in axes.containers]


def test_curves_of_two_groups_have_names_of_their_own(tmp_path):
    for fingerprint, value in (("first", 0.3), ("second", 0.6)):
        for m in (8, 32):
            scores = {"test/sampled/accuracy": value}
            put(tmp_path / fingerprint, "fps", m, scores, dataset_fingerprint=fingerprint)

    figures = plots(build_report(tmp_path))

    assert list(figures) == ["accuracy_curves", "accuracy_curves_2"]
    first, second = figures.values()
    assert curves_of(first.axes[0]) == [[30, 30]]
    assert curves_of(second.axes[0]) == [[60, 60]]


def test_curves_have_error_bars_in_the_unit_of_the_values(tmp_path):
    for m in (8, 32):
        put(tmp_path / "0", "fps", m, {"test/sampled/accuracy": 0.5}, seed=0)
        put(tmp_path / "1", "fps", m, {"test/sampled/accuracy": 0.7}, seed=1)

    (figure,) = plots(build_report(tmp_path)).values()

    bars: Any = figure.axes[0].containers[0]
    low, high = bars.lines[1]
    deviation = 100 * 0.2 / 2**0.5  # over two seeds, in percent
    lowest = 60 - deviation
    highest = 60 + deviation
    assert low.get_ydata() == pytest.approx([lowest, lowest])
    assert high.get_ydata() == pytest.approx([highest, highest])


def test_curves_have_a_panel_for_projected_points_where_there_are_any(tmp_path):
    for m in (8, 32):
        scores = {
            "test/generated/accuracy": 0.5,
            "test/matched/accuracy": 0.6,
            "test/completed/accuracy": 0.7,
            "test/projected/accuracy": m / 100,
        }
        put(tmp_path, "samplenet", m, scores)
        put(tmp_path, "fps", m, {"test/sampled/accuracy": 0.4})

    (figure,) = plots(build_report(tmp_path)).values()

    assert [axes.get_title() for axes in figure.axes] == [
        "generated",
        "matched",
        "completed",
        "projected",
    ]
    assert [8, 32] in curves_of(figure.axes[3])


def test_curves_have_a_legend_of_all_rows(tmp_path):
    for m in (8, 32):
        generated = {"test/generated/accuracy": 0.5}
        put(tmp_path, "mops", m, generated)
        put(tmp_path, "samplenet", m, {**generated, "test/projected/accuracy": 0.7})
        put(tmp_path, "fps", m, {"test/sampled/accuracy": 0.4})

    (figure,) = plots(build_report(tmp_path)).values()

    legend: Any = figure.axes[-1].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["fps", "samplenet", "mops"]


def test_curves_of_samplers_that_choose_input_points_are_dashed(tmp_path):
    for m in (8, 32):
        put(tmp_path, "fps", m, {"test/sampled/accuracy": 0.4})
        put(tmp_path, "mops", m, {"test/generated/accuracy": 0.5})

    (figure,) = plots(build_report(tmp_path)).values()

    generated, matched, _ = figure.axes
    assert styles_of(generated) == ["--", "-"]
    assert styles_of(matched) == ["--"]
    assert generated.get_xlabel() == "m"
    assert generated.get_ylabel() == "accuracy (%)"
    assert [label.get_text() for label in generated.get_xticklabels()] == ["8", "32"]


@pytest.mark.parametrize(("columns", "shape"), [(8, (1, 3)), (9, (3, 1))])
def test_panels_of_more_than_eight_columns_are_stacked(columns, shape, tmp_path):
    for number in range(columns):
        noise = {"test_noise_std": number / 100}
        put(tmp_path / f"{number}", "fps", 32, {"test/sampled/accuracy": 0.4}, config=noise)

    (figure,) = plots(build_report(tmp_path)).values()

    grid: Any = figure.axes[0].get_gridspec()
    assert (grid.nrows, grid.ncols) == shape


def test_figures_of_a_single_column_are_not_drawn(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.4})

    assert plots(build_report(tmp_path)) == {}


def test_heat_maps_show_percentages_of_each_cell_under_the_names_of_the_settings(tmp_path):
    values = {(1, 0.5): 0.1, (1, 0.9): 0.2, (10, 0.9): 0.4}
    for number, ((alpha, tau), value) in enumerate(values.items()):
        of = {"alpha": alpha, "tau": tau}
        scores = {"test/generated/accuracy": value}
        put(tmp_path / f"{number}", "mops", 32, scores, of=of)

    figure = plots(build_report(tmp_path))["accuracy_planes"]

    axes, bar = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("tau", "alpha")
    assert axes.get_title() == "mops, generated"
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0.5", "0.9"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["1", "10"]
    shown = {text.get_position(): (text.get_text(), text.get_color()) for text in axes.texts}
    assert shown == {
        (0, 0): ("10", "white"),  # on the dark end of the colours
        (1, 0): ("20", "white"),
        (1, 1): ("40", "black"),
    }
    norm = axes.images[0].norm
    assert (norm.vmin, norm.vmax) == (10, 40)
    assert bar.get_ylabel() == "accuracy (%)"


def test_heat_maps_leave_the_place_of_a_missing_readout_empty(tmp_path):
    for down, across in itertools.product((1, 2), (1, 2)):
        name = f"{down}{across}"
        values = {"generated": 1.0}
        put_cell(tmp_path, f"mops{name}", "mops", values, of={"alpha": down, "tau": across})
        values = {"generated": 1.0, "projected": 2.0}
        settings = {"beta": down, "gamma": across}
        put_cell(tmp_path, f"samplenet{name}", "samplenet", values, of=settings)

    (figure,) = plots(build_report(tmp_path)).values()

    shown = {axis.get_title() for axis in figure.axes if axis.axison} - {""}
    assert shown == {"mops, generated", "samplenet, generated", "samplenet, projected"}
    assert [len(axis.images) for axis in figure.axes if not axis.axison] == [0]


@pytest.mark.parametrize(("ratio", "kind"), [(20, Normalize), (21, LogNorm)])
def test_heat_maps_are_logarithmic_beyond_twenty_times_the_smallest_value(ratio, kind, tmp_path):
    for down, across in itertools.product((1, 2), (1, 2)):
        value = 1.0
        if (down, across) == (2, 2):
            value = ratio
        of = {"alpha": down, "tau": across}
        put_cell(tmp_path, f"{down}{across}", "mops", {"generated": value}, of=of)

    (figure,) = plots(build_report(tmp_path)).values()

    assert type(figure.axes[0].images[0].norm) is kind
