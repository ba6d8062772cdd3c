from typing import Any

import pytest
from matplotlib.colors import LogNorm, Normalize

from mops_lightning.report.build import build_report
from mops_lightning.report.plots import plots
from tests.support.reports import put, put_cell


@pytest.mark.parametrize(("far", "kind"), [(3.0, Normalize), (12000.0, LogNorm)])
def test_heat_maps_have_a_colour_scale_per_sampler(far, kind, tmp_path):
    for sampler, keys in (("mops", ("alpha", "tau")), ("samplenet", ("beta", "gamma"))):
        for down, across in ((1, 1), (1, 2), (2, 1), (2, 2)):
            corner = sampler == "samplenet" and down + across == 4
            values = {"generated": far if corner else 1.0 + across, "matched": 2.0}
            settings = dict(zip(keys, (down, across), strict=True))
            put_cell(tmp_path, f"{sampler}{down}{across}", sampler, values, of=settings)
    figure = plots(build_report(tmp_path))["nre_cd_planes"]
    scales = {axis.get_title(): axis.images[0].norm for axis in figure.axes if axis.images}
    assert type(scales["samplenet, generated"]) is kind
    assert scales["samplenet, generated"].vmax == far
    assert scales["samplenet, matched"] is scales["samplenet, generated"]
    assert type(scales["mops, generated"]) is Normalize
    assert scales["mops, generated"].vmax == 3.0
    texts = [text.get_text() for axis in figure.axes for text in axis.texts]
    assert ("12,000" if kind is LogNorm else "3") in texts


def test_curves_show_values_by_size(tmp_path):
    for m in (8, 32):
        put(tmp_path, "fps", m, {"test/sampled/accuracy": m / 100})
        put(tmp_path, "mops", m, {"test/generated/accuracy": m / 50, "test/matched/accuracy": 0.5})
    (figure,) = plots(build_report(tmp_path)).values()
    panels: list[list[Any]] = [list(axes.containers) for axes in figure.axes]
    first, second, third = panels
    fps, mops = first
    assert fps.lines[0].get_ydata().tolist() == [8, 32]
    assert mops.lines[0].get_ydata().tolist() == [16, 64]
    assert second[1].lines[0].get_ydata().tolist() == [50, 50]
    assert len(third) == 1  # no run has completed sets of MOPS-Net
    grids = [axes.xaxis.get_gridlines()[0].get_visible() for axes in figure.axes]
    assert grids == [True, True, True]


def test_curves_have_a_panel_for_projected_points_where_there_are_any(tmp_path):
    for m in (8, 32):
        scores = {"generated": 0.5, "matched": 0.6, "completed": 0.7, "projected": m / 100}
        put(tmp_path, "samplenet", m, {f"test/{name}/accuracy": v for name, v in scores.items()})
        put(tmp_path, "fps", m, {"test/sampled/accuracy": 0.4})

    (figure,) = plots(build_report(tmp_path)).values()

    assert [axes.get_title() for axes in figure.axes] == [
        "generated",
        "matched",
        "completed",
        "projected",
    ]
    drawn: list[Any] = list(figure.axes[3].containers)
    assert [8, 32] in [container.lines[0].get_ydata().tolist() for container in drawn]
