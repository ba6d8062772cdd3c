from typing import Any

import pytest
from matplotlib.colors import LogNorm, Normalize

from mops_lightning.report.build import build_report
from mops_lightning.report.plots import plots
from tests.support.reports import put, put_cell


@pytest.mark.parametrize(("far", "kind"), [(3.0, Normalize), (12000.0, LogNorm)])
def test_heat_maps_wide_range_has_logarithmic_colours(far, kind, tmp_path):
    for sampler, keys in (("mops", ("alpha", "tau")), ("samplenet", ("beta", "gamma"))):
        for down, across in ((1, 1), (1, 2), (2, 1), (2, 2)):
            corner = sampler == "samplenet" and down + across == 4
            values = {"generated": far if corner else 1.0 + across, "matched": 2.0}
            settings = dict(zip(keys, (down, across), strict=True))
            put_cell(tmp_path, f"{sampler}{down}{across}", sampler, values, of=settings)
    figure = plots(build_report(tmp_path))["nre_cd_planes"]
    images = [image for axis in figure.axes for image in axis.images]
    assert {type(image.norm) for image in images} == {kind}
    assert len({(image.norm.vmin, image.norm.vmax) for image in images}) == 1, "one scale"
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
