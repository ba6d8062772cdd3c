from typing import Any

import matplotlib.image
import numpy as np
import pytest
import torch
from mpl_toolkits.mplot3d import proj3d
from PIL import Image
from torch.nn import functional as F

from mops_lightning.errors import UserError
from mops_lightning.viz import figures
from mops_lightning.viz.task_results import ReconstructionResult, reconstruction_grid


def pixels(figure, tmp_path):
    path = tmp_path / "figure.png"
    saved = figures.save_figure(figure, path)
    image = matplotlib.image.imread(saved)
    return image[..., :3]


def marked(image, name):
    """Return the number of pixels in the colour of a readout."""
    colour = np.array(figures.COLOURS[name])
    is_marked = near_colour(image, colour / 255, 0.02)
    return is_marked.sum()


def near_colour(image, colour, tolerance):
    """Return which pixels are within a tolerance of a colour in every channel."""
    differences = np.abs(image - colour)
    largest = differences.max(2)
    return largest < tolerance


def column_of(image, number, columns):
    """Return the pixels of one column of a grid of clouds."""
    width = image.shape[1] // columns
    left = number * width
    right = left + width
    return image[:, left:right]


def marked_in_column(image, number, columns, name):
    """Return the number of pixels in the colour of a readout, in one column of a grid."""
    column = column_of(image, number, columns)
    return marked(column, name)


def test_cloud_grid_draws_readout_in_its_colour(tmp_path, rand):
    points = rand(2, 300, 3)
    samples = points[:, :20]
    readouts = {
        "generated": samples,
        "matched": samples,
        "completed": samples,
    }

    figure = figures.cloud_grid(points, readouts, ["chair", "vase"])

    image = pixels(figure, tmp_path)
    assert marked_in_column(image, 1, 4, "generated") > 200
    assert marked_in_column(image, 2, 4, "matched") > 200
    assert marked_in_column(image, 3, 4, "completed") > 200


def test_cloud_grid_names_clouds_and_readouts(rand):
    points = rand(2, 300, 3)
    readouts = {"matched": points[:, :20]}

    figure = figures.cloud_grid(points, readouts, ["chair", "vase"])

    texts = set()
    for axes in figure.axes:
        texts.add(axes.get_title())
        for text in axes.texts:
            texts.add(text.get_text())
    assert {"chair", "vase", "input", "matched"} <= texts


@pytest.mark.parametrize("number", [30, 1000])
def test_matrix_figure_shows_ideal_matrix_as_diagonal_and_every_large_entry(number):
    middle = number // 2
    last = number - 1
    dense = torch.zeros(number, 4)
    dense[middle, 0] = 1.0
    dense[3, 1] = 1.0
    dense[last, 2] = 1.0
    dense[7, 3] = 1.0
    gram = dense.T @ dense

    figure = figures.matrix_figure(dense, gram, "chair")

    axes_of_matrix, axes_of_gram = figure.axes[:2]
    (matrix,) = axes_of_matrix.images
    drawn = np.asarray(matrix.get_array())
    largest = drawn.max(0)
    assert largest.tolist() == [1.0, 1.0, 1.0, 1.0]
    if number == 30:
        rows = drawn.argmax(0)
        steps = np.diff(rows)
        assert (steps > 0).all()
    bottom = number - 0.5
    assert list(matrix.get_extent()) == [-0.5, 3.5, bottom, -0.5]
    assert figure.get_suptitle() == "chair"
    (gram_image,) = axes_of_gram.images
    drawn_gram = np.asarray(gram_image.get_array())
    np.testing.assert_array_equal(drawn_gram, np.eye(4))


def test_matrix_figure_draws_the_largest_entries_of_a_column_first():
    dense = torch.zeros(6, 2)
    dense[:3, 1] = torch.tensor([0.2, 0.5, 0.3])
    dense[3:, 0] = torch.tensor([0.1, 0.6, 0.3])

    figure = figures.matrix_figure(dense, dense.T @ dense, "chair")

    (matrix,) = figure.axes[0].images
    (gram,) = figure.axes[1].images
    drawn = np.asarray(matrix.get_array())
    assert gram.get_clim() == (0, 1)
    assert drawn.max(1) == pytest.approx([0.6, 0.3, 0.1, 0.5, 0.3, 0.2])
    assert matrix.get_clim() == (0, 1)


def test_cloud_grid_frames_a_cloud_of_equal_points():
    points = torch.ones(1, 5, 3)

    figure = figures.cloud_grid(points, {"matched": points[:, :2]}, ["a"])

    axes: Any = figure.axes[0]
    assert axes.get_xlim() == (0, 2)


def test_cloud_grid_draws_samples_over_dense_cloud(tmp_path, randn):
    sphere = F.normalize(randn(8192, 3), dim=1)
    is_far = sphere[:, 0] < -0.3
    all_far = sphere[is_far]
    dense = sphere[None]
    sample = all_far[None, :100]
    readouts = {"matched": sample}

    over_dense = figures.cloud_grid(dense, readouts, [""])
    alone = figures.cloud_grid(sample, readouts, [""])

    image_over_dense = pixels(over_dense, tmp_path)
    image_alone = pixels(alone, tmp_path)
    marked_over_dense = marked(image_over_dense, "matched")
    marked_alone = marked(image_alone, "matched")
    # Without the hiding cloud the frame is tighter, hence markers cover more pixels.
    assert marked_over_dense > 0.2 * marked_alone


def test_comparison_draws_every_sample_and_whole_cloud(tmp_path, rand):
    points = rand(300, 3)
    sample = points[:20]
    samples = {"fps": sample, "generated": sample}
    captions = {
        "fps": "fps: 78.75 %",
        "generated": "MOPSNet: 96.25 %",
        "full": "all points",
    }

    figure = figures.comparison(points, samples, captions)

    titles = [axes.get_title() for axes in figure.axes]
    assert titles == ["fps: 78.75 %", "MOPSNet: 96.25 %", "all points"]
    image = pixels(figure, tmp_path)
    assert marked_in_column(image, 0, 3, "sampled") > 200
    assert marked_in_column(image, 1, 3, "generated") > 200


def test_save_figure_png_has_a_palette_near_the_colours(tmp_path):
    rng = np.random.default_rng(0)
    squares = rng.random((4, 4, 3))
    figure = figures.new_figure(4, 4)
    axes = figure.subplots()
    axes.imshow(squares, interpolation="nearest")
    path = tmp_path / "a.png"

    saved = figures.save_figure(figure, path, dpi=100)

    with Image.open(saved) as image:
        assert image.size == (400, 400)
        assert image.mode == "P"
        drawn = np.asarray(image.convert("RGB")) / 255
    for colour in squares.reshape(-1, 3):
        is_near = near_colour(drawn, colour, 0.02)
        assert is_near.any()


def test_save_clouds_large_thins_input_and_keeps_samples(tmp_path, rand):
    points = rand(2, 20_000, 3)
    samples = points[:, :4096]
    path = tmp_path / "clouds.npz"

    figures.save_clouds(path, points, {"generated": samples}, ["a", "b"])

    titles, arrays = figures.load_clouds(path)
    assert titles == ["a", "b"]
    assert list(arrays) == ["input", "generated"]
    _, number_of_points, _ = arrays["input"].shape
    assert number_of_points <= figures.MAX_INPUT_POINTS
    np.testing.assert_array_equal(arrays["generated"], samples.numpy())


DAMAGES: dict[str, dict[str, np.ndarray]] = {
    "cut": {},
    "text": {},
    "no samples": {},
    "objects": {"generated": np.array([{}, {}], dtype=object)},
    "nan": {"generated": np.full((2, 4, 3), np.nan, np.float32)},
    "flat": {"input": np.zeros((2, 3), np.float32)},
    "flat samples": {"generated": np.zeros((2, 3))},
    "texts": {"generated": np.zeros((2, 3, 3), "U1")},
    "one title": {"titles": np.array(["a"])},
    "no letters": {"titles": np.array([0x7FFFFFFF] * 2, "<u4").view("<U1")},
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_load_clouds_damaged_file_is_refused(tmp_path, rand, damage):
    path = tmp_path / "clouds.npz"
    points = rand(2, 50, 3)
    samples = {"generated": points[:, :4]}
    figures.save_clouds(path, points, samples, ["a", "b"])
    arrays = dict(np.load(path))
    arrays.update(DAMAGES[damage])
    if damage == "no samples":
        del arrays["generated"]
    np.savez(path, **arrays)
    if damage == "cut":
        content = path.read_bytes()
        path.write_bytes(content[:-200])
    elif damage == "text":
        path.write_bytes(b"text")

    with pytest.raises(UserError, match=r"clouds\.npz: cannot read saved clouds: .+\.$"):
        figures.load_clouds(path)


def test_reconstruction_grid_thins_large_clouds_only(rand):
    most = figures.MAX_INPUT_POINTS
    points = rand(1, 2 * most, 3)
    sample = points[:, :8]
    from_sample = points[:, :100]
    result = ReconstructionResult(sample, from_sample, [1.5])

    figure = reconstruction_grid(points, points, {"fps": result}, ["chair"])

    above, below, samples, reconstruction = figure.axes
    assert drawn_points(above) == [most]
    assert drawn_points(below) == [most]
    assert drawn_points(samples) == [most, 8]
    assert drawn_points(reconstruction) == [100]
    caption = reconstruction.texts[0]
    assert caption.get_text() == "NRE 1.50"


def drawn_points(axes):
    """Return the number of points of every collection of axes."""
    numbers = []
    for collection in axes.collections:
        offsets = np.asarray(collection.get_offsets())
        numbers.append(len(offsets))
    return numbers


UPRIGHT_AXES = {
    "x": [2, 0, 1],
    "y": [0, 1, 2],
    "z": [1, 2, 0],
}
"""The axes to the right, up and to the viewer."""


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_view_upright_draws_the_upper_end_above_and_no_mirror_image(up):
    directions = torch.eye(3)
    tripod = torch.zeros(1, 4, 3)  # the origin, and one step to the right, up and to the viewer
    tripod[0, 1:] = directions[UPRIGHT_AXES[up]]
    figure = figures.cloud_grid(tripod, {}, [""])

    figures.view_upright(figure, up)

    axes: Any = figure.axes[0]
    projection = axes.get_proj()
    (upright,) = figures.upright(tripod)
    flat = []
    for point in upright:
        x, y, _ = proj3d.proj_transform(*point, projection)
        flat.append(np.array([x, y]))
    origin, right, above, front = flat
    sideways, upwards = above - origin
    assert upwards > 10 * abs(sideways)
    # Turned about the vertical, the other two keep their order: seen from above, anticlockwise.
    to_front = front - origin
    to_right = right - origin
    ground = np.stack([to_front, to_right])
    assert np.linalg.det(ground) > 0


def test_clouds_are_seen_with_y_up_unless_another_axis_is_asked_for(rand):
    figure = figures.cloud_grid(rand(1, 9, 3), {}, [""])
    axes: Any = figure.axes[0]
    by_default = axes.get_proj()

    figures.view_upright(figure, "y")

    np.testing.assert_array_equal(axes.get_proj(), by_default)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_to_y_up_is_a_rotation_that_raises_the_vertical_axis(up):
    axes = torch.eye(3)
    vertical = "xyz".index(up)

    turned = figures.to_y_up(axes, up)

    assert turned[vertical].tolist() == [0, 1, 0]
    assert torch.linalg.det(turned) == 1


def test_colours_by_channel_have_one_scale_for_all_sets():
    points = torch.zeros(1, 101, 4)
    points[0, :, 3] = torch.arange(101)
    rows = [0, 50, 100]
    sets = {
        "input": points,
        "sampled": points[:, rows],
    }

    colours = figures.colours_by_channel(3, sets)

    of_input = colours["input"]
    of_sample = colours["sampled"]
    assert of_input.shape == (1, 101, 3)
    np.testing.assert_array_equal(of_sample, of_input[:, rows])
    dark, middle, bright = of_sample[0].sum(1)
    assert dark < middle < bright


def test_colours_by_a_constant_channel_are_equal():
    points = torch.ones(2, 9, 4)

    colours = figures.colours_by_channel(3, {"input": points})

    of_points = colours["input"].reshape(-1, 3)
    different = np.unique(of_points, axis=0)
    assert len(different) == 1


BRIGHT = np.array([253, 231, 37]) / 255
DARK = np.array([68, 1, 84]) / 255


def test_cloud_grid_draws_points_in_the_colours_of_a_channel(tmp_path, rand):
    points = rand(1, 300, 4)
    is_above = points[..., 1] > 0.5
    points[..., 3] = is_above.float()  # bright above, dark below
    readouts = {"sampled": points[:, :40]}

    figure = figures.cloud_grid(points, readouts, ["a cloud"], channel=3)

    image = pixels(figure, tmp_path)
    for number in (0, 1):
        column = column_of(image, number, 2)
        is_bright = near_colour(column, BRIGHT, 0.1)
        is_dark = near_colour(column, DARK, 0.1)
        bright_rows, _ = is_bright.nonzero()
        dark_rows, _ = is_dark.nonzero()
        assert len(bright_rows) > 50
        assert len(dark_rows) > 50
        assert bright_rows.mean() < dark_rows.mean()


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_saved_figure_says_what_wrote_it_and_no_date(suffix, tmp_path):
    figure = figures.new_figure(1, 1)

    saved = figures.save_figure(figure, tmp_path / f"a.{suffix}", software="a program 1.2")

    content = saved.read_bytes()
    assert b"a program 1.2" in content
    assert b"<dc:date>" not in content
    if suffix == "png":
        with Image.open(saved) as image:
            assert image.info["Software"] == "a program 1.2"


def test_images_in_a_vector_graphic_have_the_resolution_that_is_asked_for(tmp_path, rand):
    figure = figures.cloud_grid(rand(1, 50, 3), {}, [""])

    coarse = figures.save_figure(figure, tmp_path / "coarse.svg", dpi=50)
    fine = figures.save_figure(figure, tmp_path / "fine.svg", dpi=200)

    assert fine.stat().st_size > 1.5 * coarse.stat().st_size
