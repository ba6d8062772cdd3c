"""What figures of pairs, reconstructions and parts draw of every cloud."""

from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning.viz import figures
from mops_lightning.viz.task_results import (
    SOURCE_COLOUR,
    TARGET_COLOUR,
    ReconstructionResult,
    RegistrationResult,
    pair_grid,
    part_grid,
    reconstruction_grid,
)
from tests.support.figures import drawn_places


def assert_draws(collection, points):
    drawn = drawn_places(collection)
    expected = figures.upright(points)
    np.testing.assert_allclose(drawn, expected, atol=1e-6)


def colour_of(collection):
    """Return the colour of the first point, without its opacity."""
    colours = collection.get_facecolor()
    red, green, blue, _ = colours[0]
    return (red, green, blue)


def drawn_values(collection):
    """Return the values by which the points of a collection are coloured."""
    return np.asarray(collection.get_array())


def text_of(axes):
    first_text = axes.texts[0]
    return first_text.get_text()


def texts_of(figure):
    return [text_of(axes) for axes in figure.axes]


def titles_of(figure):
    return [axes.get_title() for axes in figure.axes]


@pytest.fixture
def pairs(randn):
    """Two sources, two targets, and the results of one readout."""
    source = randn(2, 20, 3)
    target = randn(2, 20, 3)
    moved = source + 1
    source_points = moved[:, :4]
    target_points = target[:, :5]
    result = RegistrationResult(moved, source_points, target_points, [1.25, 30.0])
    return source, target, result


def test_pair_grid_draws_every_pair_before_and_after_alignment(pairs):
    source, target, result = pairs

    figure = pair_grid(source, target, [10.0, 20.0], {"fps": result}, ["a", "b"])

    before, after = figure.axes[2:]  # of the second pair
    blue, orange = before.collections
    assert_draws(blue, source[1])
    assert_draws(orange, target[1])
    moved, still, rings_of_source, rings_of_target = after.collections
    assert_draws(moved, result.source[1])
    assert_draws(still, target[1])
    assert_draws(rings_of_source, result.source_points[1])
    assert_draws(rings_of_target, result.target_points[1])
    assert colour_of(blue) == pytest.approx(SOURCE_COLOUR)
    assert colour_of(orange) == pytest.approx(TARGET_COLOUR)
    assert colour_of(rings_of_source) == pytest.approx(SOURCE_COLOUR)
    assert colour_of(rings_of_target) == pytest.approx(TARGET_COLOUR)


def test_pair_grid_draws_no_rings_where_all_points_are_given(pairs):
    source, target, result = pairs
    of_all_points = result._replace(source_points=result.source, target_points=target)

    figure = pair_grid(source, target, [10.0, 20.0], {"full": of_all_points}, ["a", "b"])

    for after in figure.axes[1::2]:
        assert len(after.collections) == 2


def test_pair_grid_says_angles_and_errors_of_every_pair(pairs):
    source, target, result = pairs

    figure = pair_grid(source, target, [10.0, 20.0], {"fps": result}, ["a", "b"])

    assert texts_of(figure) == [
        "a, 10.0° apart",
        "rotation error 1.2°",
        "b, 20.0° apart",
        "rotation error 30.0°",
    ]
    assert titles_of(figure) == ["before (centred)", "by fps", "", ""]
    assert figure.get_supxlabel() == "source blue, target orange, sampled points ringed"


def test_pair_grid_frames_source_and_target(pairs):
    source, target, result = pairs
    far = target + 50

    figure = pair_grid(source, far, [10.0, 20.0], {"fps": result}, ["a", "b"])

    before = figure.axes[2]  # of the second pair
    low, high = before.get_xlim()
    drawn = torch.cat([source[1], far[1]])
    x = drawn[:, 0]
    assert low < x.min()
    assert high > x.max()


def test_reconstruction_grid_draws_every_cloud_with_its_own_results(randn):
    points = randn(2, 30, 3)
    full = randn(2, 30, 3)
    sample = points[:, :6]
    from_sample = randn(2, 25, 3)
    result = ReconstructionResult(sample, from_sample, [1.5, 2.5])

    figure = reconstruction_grid(points, full, {"fps": result}, ["a", "b"])

    assert len(figure.axes) == 8
    # Of the second cloud: the input and its reconstruction, then those of the sample.
    cloud, reconstruction, sampled, reconstruction_from_sample = figure.axes[4:]
    faint, marked = sampled.collections
    assert_draws(cloud.collections[0], points[1])
    assert_draws(reconstruction.collections[0], full[1])
    assert_draws(faint, points[1])
    assert_draws(marked, sample[1])
    assert_draws(reconstruction_from_sample.collections[0], from_sample[1])
    assert text_of(sampled) == "6 points"
    assert text_of(reconstruction_from_sample) == "NRE 2.50"


def test_reconstructions_are_coloured_by_depth_and_framed_as_their_clouds(randn):
    points = randn(1, 30, 3)
    full = 5 * points
    sample = points[:, :6]
    result = ReconstructionResult(sample, full, [1.5])

    figure = reconstruction_grid(points, full, {"fps": result}, ["a"])

    cloud, reconstruction, *_ = figure.axes
    depth = drawn_values(reconstruction.collections[0])
    z = full[0, :, 2]
    np.testing.assert_allclose(depth, -z)
    assert reconstruction.get_xlim() == cloud.get_xlim()


def test_part_grid_colours_every_cloud_by_its_own_parts_on_one_scale(randn):
    points = randn(2, 4, 3)
    true_of_first = [0, 1, 2, 0]
    true_of_second = [2, 2, 1, -1]
    found_of_first = [0, 0, 0, 0]
    found_of_second = [1, 1, 1, 3]
    sets = {
        "true": torch.tensor([true_of_first, true_of_second]),
        "found": torch.tensor([found_of_first, found_of_second]),
    }

    figure = part_grid(points, sets, ["a", "b"])

    axes_of_true, axes_of_found = figure.axes[2:]  # of the second cloud
    (true,) = axes_of_true.collections
    (found,) = axes_of_found.collections
    assert_draws(true, points[1])
    assert_draws(found, points[1])
    assert drawn_values(true).tolist() == true_of_second
    assert drawn_values(found).tolist() == found_of_second
    assert true.get_clim() == (0, 3)
    assert found.get_clim() == (0, 3)
    assert titles_of(figure) == ["true", "found", "", ""]
    assert texts_of(figure) == ["a", "", "b", ""]


def test_part_grid_thins_parts_as_it_thins_points(randn, monkeypatch):
    monkeypatch.setattr(figures, "MAX_INPUT_POINTS", 10)
    points = randn(1, 30, 3)
    parts = torch.arange(30)[None]

    figure = part_grid(points, {"true": parts}, ["a"])

    (drawn,) = figure.axes[0].collections
    assert_draws(drawn, points[0, ::3])
    assert drawn_values(drawn).tolist() == list(range(0, 30, 3))


def test_cloud_grid_draws_the_samples_of_every_cloud(randn):
    points = randn(2, 30, 4)
    sample = points[:, :5]

    figure = figures.cloud_grid(points, {"matched": sample}, ["a", "b"], channel=3)

    whole, sampled = figure.axes[2:]  # of the second cloud
    faint, marked = sampled.collections
    second_cloud = points[1, :, :3]
    second_sample = sample[1, :, :3]
    assert_draws(whole.collections[0], second_cloud)
    assert_draws(faint, second_cloud)
    assert_draws(marked, second_sample)
    sets = {"input": points, "matched": sample}
    colours = figures.colours_by_channel(3, sets)
    first_colour = colours["matched"][1, 0]
    assert colour_of(marked) == pytest.approx(tuple(first_colour))


def test_clouds_are_drawn_with_one_scale_on_all_axes():
    low = [0.0, 0.0, 0.0]
    high = [8.0, 1.0, 2.0]
    points = torch.tensor([[low, high]])

    figure = figures.cloud_grid(points, {}, [""])

    axes: Any = figure.axes[0]
    # The middle of each axis, and half of the longest side around it.
    assert axes.get_xlim() == pytest.approx((0, 8))
    assert axes.get_ylim() == pytest.approx((-5, 3))
    assert axes.get_zlim() == pytest.approx((-3.5, 4.5))
    width, depth, height = axes._box_aspect
    assert width == depth == height


@pytest.mark.parametrize(
    ("number", "area"),
    [
        (256, 22.0),
        (512, 11.0),
        (5000, 1.5),
    ],
)
def test_markers_of_many_samples_shrink_to_a_least_size(number, area, rand):
    points = rand(1, 6000, 3)
    sample = points[:, :number]

    figure = figures.cloud_grid(points, {"matched": sample}, [""])

    sampled: Any = figure.axes[1]
    _, marked = sampled.collections
    sizes = marked.get_sizes()
    assert sizes.tolist() == [area]


def test_colours_leave_out_the_most_extreme_hundredth_at_both_ends():
    values = torch.arange(201.0)
    values[200] = 1e6
    points = torch.zeros(1, 201, 4)
    points[0, :, 3] = values

    colours_of_sets = figures.colours_by_channel(3, {"input": points})

    (colours,) = colours_of_sets["input"]
    lowest, at_low_limit, above_low_limit = colours[[0, 2, 4]]
    below_high_limit, at_high_limit, highest = colours[[196, 198, 200]]
    np.testing.assert_array_equal(lowest, at_low_limit)
    assert (at_low_limit != above_low_limit).any()
    np.testing.assert_array_equal(at_high_limit, highest)
    assert (below_high_limit != at_high_limit).any()


def test_points_of_unknown_part_are_grey():
    points = torch.rand(1, 3, 3)
    parts = torch.tensor([[0, -1, 5]])

    figure = part_grid(points, {"true": parts}, ["a"])

    (drawn,) = figure.axes[0].collections
    _, unknown, _ = drawn.to_rgba(drawn_values(drawn))
    light_grey = (211 / 255, 211 / 255, 211 / 255, 1.0)
    assert tuple(unknown) == pytest.approx(light_grey)


def test_samples_are_framed_as_their_cloud(randn):
    points = randn(1, 30, 3)
    near_the_middle = 0.1 * points[:, :5]

    figure = figures.cloud_grid(points, {"matched": near_the_middle}, [""])

    whole, sampled = figure.axes
    assert sampled.get_xlim() == whole.get_xlim()
