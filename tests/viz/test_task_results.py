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
    np.testing.assert_allclose(drawn_places(collection), figures.upright(points), atol=1e-6)


def colour_of(collection):
    colour = collection.get_facecolor()[0]
    return tuple(colour[:3])


@pytest.fixture
def pairs(randn):
    """Two sources, two targets, and the results of one readout."""
    source = randn(2, 20, 3)
    target = randn(2, 20, 3)
    moved = source + 1
    result = RegistrationResult(moved, moved[:, :4], target[:, :5], [1.25, 30.0])
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


def test_pair_grid_says_angles_and_errors_of_every_pair(pairs):
    source, target, result = pairs

    figure = pair_grid(source, target, [10.0, 20.0], {"fps": result}, ["a", "b"])

    labels = [axes.texts[0].get_text() for axes in figure.axes]
    titles = [axes.get_title() for axes in figure.axes]
    assert labels == [
        "a, 10.0° apart",
        "rotation error 1.2°",
        "b, 20.0° apart",
        "rotation error 30.0°",
    ]
    assert titles == ["before (centred)", "by fps", "", ""]


def test_pair_grid_frames_source_and_target(pairs):
    source, target, result = pairs
    far = target + 50

    figure = pair_grid(source, far, [10.0, 20.0], {"fps": result}, ["a", "b"])

    low, high = figure.axes[2].get_xlim()
    x = torch.cat([source[1, :, 0], far[1, :, 0]])
    assert low < x.min()
    assert high > x.max()


def test_reconstruction_grid_draws_every_cloud_with_its_own_results(randn):
    points = randn(2, 30, 3)
    full = randn(2, 30, 3)
    result = ReconstructionResult(points[:, :6], randn(2, 25, 3), [1.5, 2.5])

    figure = reconstruction_grid(points, full, {"fps": result}, ["a", "b"])

    assert len(figure.axes) == 8
    # Of the second cloud: the input and its reconstruction, then those of the sample.
    cloud, from_all, samples, reconstruction = figure.axes[4:]
    assert_draws(cloud.collections[0], points[1])
    assert_draws(from_all.collections[0], full[1])
    assert_draws(samples.collections[0], points[1])
    assert_draws(samples.collections[1], result.samples[1])
    assert_draws(reconstruction.collections[0], result.points[1])
    assert samples.texts[0].get_text() == "6 points"
    assert reconstruction.texts[0].get_text() == "NRE 2.50"


def test_reconstructions_are_coloured_by_depth_and_framed_as_their_clouds(randn):
    points = randn(1, 30, 3)
    full = 5 * points
    result = ReconstructionResult(points[:, :6], full, [1.5])

    figure = reconstruction_grid(points, full, {"fps": result}, ["a"])

    cloud, from_all, *_ = figure.axes
    depth = np.asarray(from_all.collections[0].get_array())
    np.testing.assert_allclose(depth, -full[0, :, 2])
    assert from_all.get_xlim() == cloud.get_xlim()


def test_part_grid_colours_every_cloud_by_its_own_parts_on_one_scale(randn):
    points = randn(2, 4, 3)
    true = torch.tensor([[0, 1, 2, 0], [2, 2, 1, -1]])
    found = torch.tensor([[0, 0, 0, 0], [1, 1, 1, 3]])

    figure = part_grid(points, {"true": true, "found": found}, ["a", "b"])

    of_second = figure.axes[2:]
    for axes, parts in zip(of_second, (true, found), strict=True):
        (collection,) = axes.collections
        assert_draws(collection, points[1])
        drawn = np.asarray(collection.get_array())
        assert drawn.tolist() == parts[1].tolist()
        assert collection.get_clim() == (0, 3)
    titles = [axes.get_title() for axes in figure.axes]
    labels = [axes.texts[0].get_text() for axes in figure.axes]
    assert titles == ["true", "found", "", ""]
    assert labels == ["a", "", "b", ""]


def test_cloud_grid_draws_the_samples_of_every_cloud(randn):
    points = randn(2, 30, 4)
    sample = points[:, :5]

    figure = figures.cloud_grid(points, {"matched": sample}, ["a", "b"], channel=3)

    whole, sampled = figure.axes[2:]
    faint, marked = sampled.collections
    assert_draws(whole.collections[0], points[1, :, :3])
    assert_draws(faint, points[1, :, :3])
    assert_draws(marked, sample[1, :, :3])
    colours = figures.colours_by_channel(3, {"input": points, "matched": sample})
    first_colour = tuple(colours["matched"][1, 0])
    assert colour_of(marked) == pytest.approx(first_colour)


def test_clouds_are_drawn_with_one_scale_on_all_axes():
    points = torch.tensor([[[0.0, 0, 0], [8, 1, 2]]])

    figure = figures.cloud_grid(points, {}, [""])

    axes: Any = figure.axes[0]
    # The middle of each axis, and half of the longest side around it.
    assert axes.get_xlim() == pytest.approx((0, 8))
    assert axes.get_ylim() == pytest.approx((-5, 3))
    assert axes.get_zlim() == pytest.approx((-3.5, 4.5))


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

    figure = figures.cloud_grid(points, {"matched": points[:, :number]}, [""])

    axes: Any = figure.axes[1]
    _, marked = axes.collections
    assert marked.get_sizes().tolist() == [area]


def test_colours_leave_out_the_most_extreme_hundredth_at_both_ends():
    points = torch.zeros(1, 201, 4)
    points[0, :, 3] = torch.arange(201)
    points[0, 200, 3] = 1e6

    colours = figures.colours_by_channel(3, {"input": points})["input"][0]

    np.testing.assert_array_equal(colours[0], colours[2])
    assert (colours[2] != colours[4]).any()
    np.testing.assert_array_equal(colours[198], colours[200])
    assert (colours[196] != colours[198]).any()
