import numpy as np
from PIL import Image

from mops_lightning.viz.figures import new_figure, save_figure


def test_save_figure_png_has_a_palette_near_the_colours(tmp_path):
    figure = new_figure(4, 4)
    colours = np.random.default_rng(0).random((4, 4, 3))
    figure.subplots().imshow(colours, interpolation="nearest")
    with Image.open(save_figure(figure, tmp_path / "a.png", dpi=100)) as image:
        assert image.size == (400, 400)
        assert image.mode == "P"
        drawn = np.asarray(image.convert("RGB")).reshape(-1, 3) / 255
    assert all(np.abs(drawn - colour).max(1).min() < 0.02 for colour in colours.reshape(-1, 3))


def test_save_figure_svg_has_no_date(tmp_path):
    figure = new_figure(4, 4)
    figure.subplots()
    text = save_figure(figure, tmp_path / "a.svg").read_text()
    assert text.startswith("<?xml")
    assert "dc:date" not in text
