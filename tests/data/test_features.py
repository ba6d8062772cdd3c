"""Features of files: columns by name, or estimated, and how they are scaled."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch.testing import assert_close

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.cloud_folder import cloud_folder
from mops_lightning.data.features import check_features, feature_values
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.ops.normals import upward_normals
from mops_lightning.ops.weights import curvature
from tests.support.cloud_files import write_cloud
from tests.support.clouds import normal_points, uniform_points

PATH = Path("scan.ply")


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3))
    columns = {
        "Intensity": rng.integers(0, 255, 40),
        "ring": np.arange(40),
    }
    return Table(points, columns)


UP = [0.0, 0.0, 1.0]


def copies(row, number):
    """Return one row several times."""
    return np.tile(row, (number, 1))


def test_features_are_columns_in_the_order_of_their_names(table):
    values = feature_values(table, ("ring", "intensity"), PATH, "features")

    assert_array_equal(values[:, 0], table.columns["ring"])
    assert_array_equal(values[:, 1], table.columns["Intensity"])
    assert values.shape == (40, 2)


def test_features_are_found_whatever_their_capitals_unless_several_differ_in_them(table):
    numbers = np.arange(40.0)
    several = table.with_columns({"RING": numbers + 100, "Time": numbers, "TIME": -numbers})

    ring, capitals = feature_values(several, ("ring", "RING"), PATH, "features").T

    assert_array_equal(ring, numbers)
    assert_array_equal(capitals, numbers + 100)
    with pytest.raises(UserError, match="has no column 'time'"):
        feature_values(several, ("time",), PATH, "features")


def test_features_without_columns_are_estimated(table):
    values = feature_values(table, ("normals", "curvature"), PATH, "features")

    normals = upward_normals(table.points)
    curvatures = curvature(table.points)
    assert_array_equal(values[:, :3], normals)
    assert_array_equal(values[:, 3], curvatures)


@pytest.mark.parametrize(
    "names",
    [
        ("nx", "ny", "nz"),
        ("normal_x", "normal_y", "normal_z"),
        ("NormalX", "NormalY", "NormalZ"),
    ],
)
def test_normals_of_the_file_come_first_and_have_length_one(table, names):
    stored = copies([0.0, 3.0, 4.0], 40)
    stored[7] = 0.0
    columns = dict(zip(names, stored.T, strict=True))
    with_normals = table.with_columns(columns)

    values = feature_values(with_normals, ("normals",), PATH, "features")

    expected = copies([0.0, 0.6, 0.8], 40)
    expected[7] = 0.0
    assert_allclose(values, expected)


def test_normals_are_estimated_where_the_file_lacks_one_of_their_columns(table):
    ones = np.ones(40)
    partly = table.with_columns({"nx": ones, "ny": ones})

    values = feature_values(partly, ("normals",), PATH, "features")

    assert_array_equal(values, upward_normals(table.points))


def test_normals_with_one_missing_number_are_refused(table):
    stored = copies(UP, 40)
    stored[4, 1] = np.nan
    columns = dict(zip(("nx", "ny", "nz"), stored.T, strict=True))
    broken = table.with_columns(columns)

    with pytest.raises(UserError, match=r"1 of 40 points of scan\.ply have no finite normals"):
        feature_values(broken, ("normals",), PATH, "features")


@pytest.mark.parametrize(
    ("along", "expected"),
    [
        ([3.0, 4.0, 0.0], [-0.8, 0.6, 0.0]),
        ([-3.0, 4.0, 0.0], [0.8, 0.6, 0.0]),
        ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]),
    ],
)
def test_upward_normals_of_a_wall_have_a_positive_y_or_else_x(along, expected):
    steps, heights = np.indices((6, 6)).reshape(2, 36, 1)
    wall = steps * np.array(along) + heights * np.array(UP)

    normals = upward_normals(wall)

    assert_allclose(normals, copies(expected, 36), atol=1e-9)


@pytest.mark.parametrize("points", [np.zeros((5, 3)), np.ones((1, 3))])
def test_upward_normals_of_equal_points_point_upwards(points):
    normals = upward_normals(points)

    assert_array_equal(normals, copies(UP, len(points)))


def test_upward_normals_of_a_level_plane_point_up():
    flat = uniform_points(100, 0)
    flat[:, 2] = 0

    normals = upward_normals(flat)

    assert_allclose(normals, copies(UP, 100), atol=1e-7)


def test_upward_normals_of_a_tilted_plane_are_exact_and_point_upwards():
    rng = np.random.default_rng(0)
    upward = np.array([-1.0, 2.0, 2.0]) / 3
    across = np.cross(upward, [1.0, 0, 0])
    along = np.cross(upward, across)
    steps_across = rng.random((100, 1))
    steps_along = rng.random((100, 1))
    tilted = steps_across * across + steps_along * along

    normals = upward_normals(tilted + 1000)

    assert_allclose(normals, copies(upward, 100), atol=1e-6)


def test_upward_normals_agree_with_a_plain_loop():
    points = normal_points(50, 1)

    normals = upward_normals(points)

    for point, normal in zip(points, normals, strict=True):
        squares = np.square(points - point).sum(1)
        rows = squares.argsort()[:12]
        near = points[rows]
        centred = near - near.mean(0)
        _, _, directions = np.linalg.svd(centred)
        direction = directions[2]
        if direction[2] < 0:
            direction = -direction
        assert_allclose(normal, direction, atol=1e-9)


def test_missing_column_lists_what_the_file_has(table):
    with pytest.raises(UserError) as caught:
        feature_values(table, ("ring", "intensty"), PATH, "dataset.features")

    assert str(caught.value) == (
        "dataset.features: scan.ply has no column 'intensty' of ring, intensty. Did you mean "
        "'Intensity'? Allowed: Intensity, curvature, normals, ring."
    )


def test_missing_values_are_refused_with_their_number(table):
    intensity = table.columns["Intensity"].astype(float)
    intensity[[3, 5, 8]] = np.nan
    broken = table.with_columns({"Intensity": intensity})

    with pytest.raises(UserError, match=r"3 of 40 points of scan\.ply have no finite intensity"):
        feature_values(broken, ("intensity",), PATH, "features")


@pytest.mark.parametrize(
    ("features", "message"),
    [
        ("intensity", r"features must be a list of names, such as .* got 'intensity'"),
        ([1], r"features must be a list of names, such as .* got \[1\]"),
        (["ring", "ring"], "features: ring is named twice"),
        (["x"], "features: x is a coordinate, which every net sees"),
        (["X"], "features: X is a coordinate, which every net sees"),
        (["nx", "ny", "nz"], "features: give normals in place of nx"),
        (["NX"], "features: give normals in place of NX"),
        (["NormalZ"], "features: give normals in place of NormalZ"),
    ],
)
def test_wrong_features_raise(features, message):
    with pytest.raises(UserError, match=message):
        check_features(features)


@pytest.fixture
def folder(tmp_path):
    """Four clouds; intensity is 100 plus ten times the file's number plus x."""
    for number in range(4):
        points = normal_points(60, number)
        columns = {
            "intensity": 100 + 10 * number + points[:, 0],
            "other": np.arange(60.0),
            "same": np.full(60, 7.0),
        }
        write_cloud(tmp_path / f"scan_{number}.ply", points, columns)
    return tmp_path


def of(folder, features, **more):
    settings = {"n_points": 60, "crop": "whole", "crops": 1, "test_frames": None, **more}
    return cloud_folder(folder, features=features, **settings)


def test_cloud_folder_channels_have_mean_zero_and_spread_one_over_the_training_clouds(folder):
    data = of(folder, ["intensity", "normals"])

    channels = data.channels
    assert channels.names == ("intensity", "normal_x", "normal_y", "normal_z")
    assert channels.columns[1] == Channel("normal_x", 0.0, 1.0)
    assert data.train.points.shape == (3, 60, 7)
    intensity = data.train.points[..., 3]
    assert abs(intensity.mean()) < 1e-5
    assert abs(intensity.std(correction=0) - 1) < 1e-5
    normals = data.test.points[..., 4:]
    lengths = normals.norm(dim=2)
    assert_close(lengths, torch.ones(1, 60))


def test_cloud_folder_constant_feature_is_moved_to_zero_only(folder):
    data = of(folder, ["same"])

    assert data.channels.columns == (Channel("same", 7.0, 1.0),)
    assert data.train.points[..., 3].abs().max() == 0


def test_cloud_folder_each_feature_is_scaled_by_its_own_statistics_normals_by_none(folder):
    data = of(folder, ["intensity", "normals", "other"])

    values = data.train.points[..., 3:].reshape(-1, 5)
    scaled = values[:, [0, 4]]
    means = scaled.mean(0)
    spreads = scaled.std(0, correction=0)
    lengths = values[:, 1:4].norm(dim=1)
    assert_close(means, torch.zeros(2), atol=1e-5, rtol=0)
    assert_close(spreads, torch.ones(2))
    assert_close(lengths, torch.ones(180))
    name, mean, spread = data.channels.columns[4]
    assert name == "other"
    assert mean == pytest.approx(29.5)
    assert spread == pytest.approx(np.arange(60).std())


def test_cloud_folder_coordinates_do_not_depend_on_features(folder):
    with_features = of(folder, ["intensity"])
    without = of(folder, None)

    train = with_features.train.points[..., :3]
    test = with_features.test.points[..., :3]
    assert torch.equal(train, without.train.points)
    assert torch.equal(test, without.test.points)
    assert with_features.fingerprint != without.fingerprint
    assert without.channels == PointChannels()


def test_cloud_folder_channels_are_restored_to_those_of_the_file(folder):
    data = of(folder, ["intensity", "normals"])

    scaled = data.test.points[..., 3:].double()
    restored = data.channels.restored(scaled)

    mean = restored[..., 0].mean().item()
    number_of_file = round((mean - 100) / 10)
    mean_of_file = 100 + 10 * number_of_file
    assert mean == pytest.approx(mean_of_file, abs=1)


def test_cloud_folder_channels_belong_to_their_points(folder):
    crops: dict[str, Any] = {"crop": "nearest", "n_points": 20, "crops": 3}
    data = of(folder, ["intensity"], **crops)

    points = data.train.points.double()
    x = points[..., 0]
    restored = data.channels.restored(points[..., 3:])
    intensities = restored[..., 0]
    # In a file intensity differs from x by a constant; a crop is moved and scaled.
    for x_of_cloud, intensity in zip(x, intensities, strict=True):
        correlations = torch.corrcoef(torch.stack([x_of_cloud, intensity]))
        assert correlations[0, 1] > 0.9999


def test_cloud_folder_scaled_as_other_statistics_keeps_the_values(folder):
    data = of(folder, ["intensity"])
    trained = PointChannels([Channel("intensity", 50.0, 4.0)])

    scaled = data.scaled_as(trained, "a net")

    splits = ((data.train, scaled.train), (data.test, scaled.test))
    for before, after in splits:
        intensity = data.channels.restored(before.points[..., 3:].double())
        expected = (intensity - 50) / 4
        assert_close(after.points[..., 3:], expected.float())
    assert scaled.channels == trained
    assert data.scaled_as(data.channels, "a net") is data


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        (
            PointChannels([Channel("other"), Channel("intensity")]),
            r"a net was trained with the features other, intensity, but dataset\.features gives "
            r"intensity\. Set dataset\.features=\[other, intensity\]\.",
        ),
        (PointChannels(), "trained without features, but .* Leave features out"),
    ],
)
def test_cloud_folder_scaled_as_other_features_raises(folder, channels, message):
    with pytest.raises(UserError, match=message):
        of(folder, ["intensity"]).scaled_as(channels, "a net")


def test_cloud_folder_file_without_the_column_is_named(folder):
    points = normal_points(60, 9)
    write_cloud(folder / "bare.ply", points)

    with pytest.raises(UserError, match=r"features: .*bare\.ply has no column 'intensity'\. A"):
        of(folder, ["intensity"])


def test_cloud_folder_surface_has_no_features(folder):
    with pytest.raises(UserError, match=r"features must be null with crop=surface, got \['a'\]"):
        of(folder, ["a"], crop="surface")
