"""Features of files: columns by name, or estimated, and how they are scaled."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.cloud_folder import cloud_folder
from mops_lightning.data.features import check_features, feature_values
from mops_lightning.data.formats.registry import WRITERS
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.ops.normals import upward_normals
from mops_lightning.ops.weights import curvature

PATH = Path("scan.ply")


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3))
    columns = {"Intensity": rng.integers(0, 255, 40), "ring": np.arange(40)}
    return Table(points, columns)


def test_features_are_columns_in_the_order_of_their_names(table):
    values = feature_values(table, ("ring", "intensity"), PATH, "features")

    expected = np.stack([table.columns["ring"], table.columns["Intensity"]], 1)
    np.testing.assert_array_equal(values, expected)


def test_features_without_columns_are_estimated(table):
    values = feature_values(table, ("normals", "curvature"), PATH, "features")

    np.testing.assert_array_equal(values[:, :3], upward_normals(table.points))
    np.testing.assert_array_equal(values[:, 3], curvature(table.points))


@pytest.mark.parametrize(
    "names",
    [("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("NormalX", "NormalY", "NormalZ")],
)
def test_normals_of_the_file_come_first_and_have_length_one(table, names):
    stored = np.tile([0.0, 3.0, 4.0], (40, 1))
    stored[7] = 0.0
    with_normals = table.with_columns(dict(zip(names, stored.T, strict=True)))

    values = feature_values(with_normals, ("normals",), PATH, "features")

    expected = np.tile([0.0, 0.6, 0.8], (40, 1))
    expected[7] = 0.0
    np.testing.assert_allclose(values, expected)


def test_upward_normals_of_planes_are_exact_and_point_upwards():
    rng = np.random.default_rng(0)
    flat = np.zeros((100, 3))
    flat[:, :2] = rng.random((100, 2))
    normal = np.array([1.0, -2.0, -2.0]) / 3
    across = np.cross(normal, [1.0, 0, 0])
    tilted = rng.random((100, 1)) * across + rng.random((100, 1)) * np.cross(normal, across)

    np.testing.assert_allclose(upward_normals(flat), np.tile([0, 0, 1.0], (100, 1)), atol=1e-7)
    np.testing.assert_allclose(upward_normals(tilted + 1000), np.tile(-normal, (100, 1)), atol=1e-6)


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
    wall = steps * np.array(along) + heights * np.array([0.0, 0.0, 1.0])

    np.testing.assert_allclose(upward_normals(wall), np.tile(expected, (36, 1)), atol=1e-9)


@pytest.mark.parametrize("points", [np.zeros((5, 3)), np.ones((1, 3))])
def test_upward_normals_of_equal_points_point_upwards(points):
    expected = np.tile([0.0, 0.0, 1.0], (len(points), 1))

    np.testing.assert_array_equal(upward_normals(points), expected)


def test_upward_normals_of_a_level_plane_point_up():
    flat = np.zeros((100, 3))
    flat[:, :2] = np.random.default_rng(0).random((100, 2))

    normals = upward_normals(flat)

    expected = np.tile([0.0, 0.0, 1.0], (100, 1))
    np.testing.assert_allclose(normals, expected, atol=1e-7)


def test_upward_normals_of_a_tilted_plane_are_exact_and_point_upwards():
    rng = np.random.default_rng(0)
    upward = np.array([-1.0, 2.0, 2.0]) / 3
    across = np.cross(upward, [1.0, 0, 0])
    along = np.cross(upward, across)
    tilted = rng.random((100, 1)) * across + rng.random((100, 1)) * along

    normals = upward_normals(tilted + 1000)

    np.testing.assert_allclose(normals, np.tile(upward, (100, 1)), atol=1e-6)


def test_upward_normals_agree_with_a_plain_loop():
    points = np.random.default_rng(1).normal(size=(50, 3))

    normals = upward_normals(points)

    for point, normal in zip(points, normals, strict=True):
        squares = np.square(points - point).sum(1)
        near = points[squares.argsort()[:12]]
        _, _, directions = np.linalg.svd(near - near.mean(0))
        direction = directions[2]
        if direction[2] < 0:
            direction = -direction
        np.testing.assert_allclose(normal, direction, atol=1e-9)


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
        (["nx", "ny", "nz"], "features: give normals in place of nx"),
    ],
)
def test_wrong_features_raise(features, message):
    with pytest.raises(UserError, match=message):
        check_features(features)


@pytest.fixture
def folder(tmp_path):
    """Four clouds; intensity is 100 plus ten times the file's number plus x."""
    for number in range(4):
        points = np.random.default_rng(number).normal(size=(60, 3))
        columns = {"intensity": 100 + 10 * number + points[:, 0], "other": np.arange(60.0)}
        WRITERS[".ply"](tmp_path / f"scan_{number}.ply", Table(points, columns))
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
    lengths = data.test.points[..., 4:].norm(dim=2)
    torch.testing.assert_close(lengths, torch.ones(1, 60))


def test_cloud_folder_each_feature_is_scaled_by_its_own_statistics_normals_by_none(folder):
    data = of(folder, ["intensity", "normals", "other"])

    values = data.train.points[..., 3:].reshape(-1, 5)
    scaled = values[:, [0, 4]]
    torch.testing.assert_close(scaled.mean(0), torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(scaled.std(0, correction=0), torch.ones(2))
    torch.testing.assert_close(values[:, 1:4].norm(dim=1), torch.ones(180))
    other = data.channels.columns[4]
    assert other == ("other", pytest.approx(29.5), pytest.approx(np.arange(60).std()))


def test_cloud_folder_coordinates_do_not_depend_on_features(folder):
    with_features = of(folder, ["intensity"])
    without = of(folder, None)

    assert torch.equal(with_features.train.points[..., :3], without.train.points)
    assert torch.equal(with_features.test.points[..., :3], without.test.points)
    assert with_features.fingerprint != without.fingerprint
    assert without.channels == PointChannels()


def test_cloud_folder_channels_are_restored_to_those_of_the_file(folder):
    data = of(folder, ["intensity", "normals"])

    restored = data.channels.restored(data.test.points[..., 3:].double())

    mean = restored[..., 0].mean().item()
    number_of_file = round((mean - 100) / 10)
    assert mean == pytest.approx(100 + 10 * number_of_file, abs=1)


def test_cloud_folder_channels_belong_to_their_points(folder):
    data = of(folder, ["intensity"], crop="nearest", n_points=20, crops=3)

    x = data.train.points[..., 0].double()
    restored = data.channels.restored(data.train.points[..., 3:].double())
    # In a file intensity differs from x by a constant; a crop is moved and scaled.
    for x_of_cloud, intensity in zip(x, restored[..., 0], strict=True):
        correlations = torch.corrcoef(torch.stack([x_of_cloud, intensity]))
        assert correlations[0, 1] > 0.9999


def test_cloud_folder_scaled_as_other_statistics_keeps_the_values(folder):
    data = of(folder, ["intensity"])
    trained = PointChannels([Channel("intensity", 50.0, 4.0)])

    scaled = data.scaled_as(trained, "a net")

    expected = trained.scaled(data.channels.restored(data.test.points[..., 3:].double())).float()
    torch.testing.assert_close(scaled.test.points[..., 3:], expected)
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
    WRITERS[".ply"](folder / "bare.ply", Table(np.random.default_rng(9).normal(size=(60, 3))))

    with pytest.raises(UserError, match=r"features: .*bare\.ply has no column 'intensity'\. A"):
        of(folder, ["intensity"])


def test_cloud_folder_surface_has_no_features(folder):
    with pytest.raises(UserError, match=r"features must be null with crop=surface, got \['a'\]"):
        of(folder, ["a"], crop="surface")
