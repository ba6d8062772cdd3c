import numpy as np
import pytest
from PIL import Image

from mops_lightning.viz.figures import MAX_PNG_BYTES, new_figure, save_figure, save_svg


def noise_figure(pixels):
    figure = new_figure(4, 4)
    rng = np.random.default_rng(0)
    figure.subplots().imshow(rng.random((pixels, pixels, 3)), interpolation="nearest")
    return figure


def test_save_figure_small_keeps_resolution_and_colours(tmp_path):
    path = save_figure(noise_figure(4), tmp_path / "a.png", dpi=100)
    with Image.open(path) as image:
        assert image.size == (400, 400)
        assert image.mode == "RGBA"


@pytest.mark.parametrize("dpi", [110, 250])
def test_save_figure_large_stays_below_limit(dpi, tmp_path):
    path = save_figure(noise_figure(400), tmp_path / "a.png", dpi=dpi)
    assert 0.3 * MAX_PNG_BYTES < path.stat().st_size <= MAX_PNG_BYTES


def test_save_svg_above_limit_removes_earlier_file(tmp_path):
    path = tmp_path / "a.svg"
    figure = new_figure(4, 4)
    axes = figure.subplots()
    assert save_svg(figure, path)
    assert path.read_text().startswith("<?xml")
    x, y = np.random.default_rng(0).random((2, 5000))
    axes.scatter(x, y, s=np.arange(5000))
    assert not save_svg(figure, path)
    assert not path.exists()
