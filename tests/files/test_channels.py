"""Files sampled by models with channels, which are columns found by their names."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from mops_lightning import downsample, load
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.files.compare import compare_file, options_by_method
from mops_lightning.files.icp.methods import ByWeights
from mops_lightning.ops.normals import upward_normals
from mops_lightning.samplers.fmops import FMOPSNet
from mops_lightning.zoo import weights
from tests.support.cloud_files import contents, write_table
from tests.support.clouds import normal_points
from tests.support.downsample import done, refused

N = 300
PATH = Path("scan.ply")
INTENSITY = Channel("intensity", 100.0, 40.0)
NORMALS = [Channel("normal_x"), Channel("normal_y"), Channel("normal_z")]


def save(path, *channels):
    """Write an FMOPS-Net with channels whose samples depend on them; return the file."""
    torch.manual_seed(0)
    settings: dict[str, Any] = {
        "m_max": 16,
        "feature_channels": [16, 8],
        "rho_channels": [12, 10],
    }
    point_channels = PointChannels(channels)
    net = FMOPSNet(point_channels=point_channels, **settings)
    net.queries.weight.data *= 100  # columns of S choose a few points, by their channels, too
    target = "mops_lightning.samplers.fmops.FMOPSNet"
    config = {"learn": "sampler", "m": 16, "sampler": {"_target_": target, **settings}}
    weights.save(path, net, config, {}, channels=point_channels)
    return path


@pytest.fixture
def model(tmp_path):
    return save(tmp_path / "model.safetensors", INTENSITY, Channel("ring", 8.0, 4.0))


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    columns: dict[str, Any] = {
        "ring": rng.integers(0, 16, N).astype(np.uint8),
        "time": rng.random(N),
        "Intensity": rng.integers(0, 255, N).astype(np.uint16),
    }
    unit = rng.normal(size=(N, 3))
    points = unit * [9, 5, 1] + 1000
    return Table(points, columns)


def matrix(table, *names):
    columns = [table.columns[name] for name in names]
    return np.column_stack([table.points, *columns])


GENERATED = ["--m", 9, "--readout", "generated"]


def generated_by(model, points):
    """Return the 9 points that a model generates in Python."""
    generated, _ = load(model).downsample(points, 9, readout="generated")
    return generated


def test_columns_are_found_by_name_in_any_order(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    write_table(source, table)

    done(source, out, "--weights", model, "--m", 9)

    kept = contents(out)
    given = matrix(table, "Intensity", "ring")
    expected, rows = load(model).downsample(given, 9)
    assert_array_equal(kept.points, expected[:, :3])
    for name, column in table.columns.items():
        assert_array_equal(kept.columns[name], column[rows])


def test_generated_points_have_channels_in_the_types_of_the_file(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    write_table(source, table)

    done(source, out, "--weights", model, *GENERATED)

    generated = contents(out)
    intensity = generated.columns["Intensity"]
    ring = generated.columns["ring"]
    given = matrix(table, "Intensity", "ring")
    expected = generated_by(model, given)
    assert list(generated.columns) == ["Intensity", "ring"]
    assert_allclose(generated.points, expected[:, :3], rtol=1e-6)
    assert intensity.dtype == np.uint16
    assert_allclose(intensity, expected[:, 3], atol=0.51)
    assert_allclose(ring, expected[:, 4], atol=0.51)


def test_generated_columns_after_normals_are_their_own(table, tmp_path):
    model = save(tmp_path / "model.safetensors", *NORMALS, INTENSITY)
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    normals = normal_points(N, 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    names = ("nx", "ny", "nz")
    columns = dict(zip(names, normals.T, strict=True))
    table = table.with_columns(columns)
    write_table(source, table)

    done(source, out, "--weights", model, *GENERATED)

    generated = contents(out).columns
    given = matrix(table, *names, "Intensity")
    expected = generated_by(model, given)
    found = np.stack([generated[name] for name in names], 1)
    assert_allclose(found, expected[:, 3:6], atol=1e-5)
    assert_allclose(generated["Intensity"], expected[:, 6], atol=0.51)


@pytest.mark.parametrize("readout", ["generated", "matched"])
@pytest.mark.parametrize("chunk", [[], ["--chunk", 70]])
def test_points_without_attributes_have_coordinates_only(chunk, readout, model, table, tmp_path):
    source = tmp_path / "in.ply"
    out = tmp_path / "out.npz"
    write_table(source, table)
    settings = ["--weights", model, "--m", 9, "--readout", readout, *chunk]

    done(source, out, *settings, "--coordinates-only")

    assert len(contents(out).points) == 9
    assert not contents(out).columns


def test_upward_normals_are_written_with_length_one(table, tmp_path):
    source = tmp_path / "in.ply"
    out = tmp_path / "out.ply"
    model = save(tmp_path / "model.safetensors", *NORMALS)
    write_table(source, table)

    done(source, out, "--weights", model, *GENERATED)

    columns = contents(out).columns
    parts = [columns[name] for name in ("nx", "ny", "nz")]
    normals = np.column_stack(parts)
    lengths = np.linalg.norm(normals, axis=1)
    assert_allclose(lengths, np.ones(9), atol=1e-6)
    upward = upward_normals(table.points)
    given = np.column_stack([table.points, upward])
    expected = generated_by(model, given)
    assert_allclose(normals, expected[:, 3:], atol=1e-4)


@pytest.mark.parametrize("readout", ["generated", "matched"])
def test_chunks_equal_the_whole_file(readout, model, table, tmp_path):
    source = tmp_path / "in.ply"
    in_whole = tmp_path / "whole.npz"
    in_parts = tmp_path / "parts.npz"
    write_table(source, table)
    settings = ["--weights", model, "--m", 9, "--readout", readout]

    done(source, in_whole, *settings)
    done(source, in_parts, *settings, "--chunk", 70)

    whole = contents(in_whole)
    parts = contents(in_parts)
    assert_allclose(parts.points, whole.points, atol=1e-3)
    assert list(parts.columns) == list(whole.columns)
    for name, column in whole.columns.items():
        assert_allclose(parts.columns[name], column, atol=1)


def test_chunks_do_not_estimate_features(table, tmp_path):
    model = save(tmp_path / "model.safetensors", *NORMALS)
    source = tmp_path / "in.ply"
    out = tmp_path / "out.ply"
    write_table(source, table)

    line = refused(source, out, "--weights", model, *GENERATED, "--chunk", 70)

    assert "in.ply has no columns of normals, which are estimated from all points of a file" in line


def test_tiles_have_the_channels_of_their_points(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    changed_source = tmp_path / "changed.npz"
    changed_out = tmp_path / "changed_out.npz"
    reversed_intensity = table.columns["Intensity"][::-1].copy()
    changed = table.with_columns({"Intensity": reversed_intensity})
    write_table(source, table)
    write_table(changed_source, changed)
    settings = ["--weights", model, "--m", 20, "--tile", 100]

    done(source, out, *settings)
    done(changed_source, changed_out, *settings)

    kept = contents(out).points
    kept_of_changed = contents(changed_out).points
    given = matrix(table, "Intensity", "ring")
    in_python, _ = downsample(given, 20, model, tile=100)
    assert_array_equal(kept, in_python[:, :3])
    assert not np.array_equal(kept, kept_of_changed)


def test_classes_have_the_channels_of_their_points(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    classes = np.repeat([5, 7], [100, 200])
    table = table.with_columns({"class": classes})
    write_table(source, table)

    done(source, out, "--weights", model, "--m", 12, "--stratify", "class:share")

    kept = contents(out)
    for name, share in ((5, 4), (7, 8)):
        members = table.take(np.flatnonzero(classes == name))
        expected, _ = load(model).downsample(matrix(members, "Intensity", "ring"), share)
        of_class = kept.points[kept.columns["class"] == name]
        assert sorted(of_class.tolist()) == sorted(expected[:, :3].tolist())


def test_weights_leave_out_points_with_their_channels(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    heavy = np.arange(N) % 3 == 0
    table = table.with_columns({"heavy": heavy.astype(np.uint8)})
    write_table(source, table)

    done(source, out, "--weights", model, "--m", 9, "--weight", "heavy")

    members = table.take(np.flatnonzero(heavy))
    expected, _ = load(model).downsample(matrix(members, "Intensity", "ring"), 9)
    kept = contents(out).points
    assert sorted(kept.tolist()) == sorted(expected[:, :3].tolist())


def test_file_without_a_column_is_refused_with_what_it_has(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    table.columns.pop("ring")
    write_table(source, table)

    line = refused(source, out, "--weights", model, "--m", 9)

    assert "--weights: " in line
    assert "in.npz has no column 'ring' of intensity, ring." in line
    assert "Allowed: Intensity, curvature, normals, time." in line


def test_missing_values_are_refused_with_their_number(model, table, tmp_path):
    source = tmp_path / "in.npz"
    out = tmp_path / "out.npz"
    intensity = table.columns["Intensity"].astype(np.float32)
    intensity[:7] = np.nan
    broken = table.with_columns({"Intensity": intensity})
    write_table(source, broken)

    line = refused(source, out, "--weights", model, "--m", 9)

    assert "7 of 300 points of " in line
    assert "have no finite intensity." in line


def test_python_takes_channels_after_the_coordinates(model, table):
    array = matrix(table, "Intensity", "ring")
    given = torch.from_numpy(array)

    points, rows = downsample(given, 9, model)
    generated, no_rows = downsample(given, 9, model, readout="generated")
    (listed,), _ = downsample([given], 9, model)

    assert torch.equal(points, given[rows])
    assert torch.equal(listed, points)
    assert generated.shape == (9, 5)
    assert no_rows is None


@pytest.mark.parametrize("columns", [3, 4, 6])
def test_python_names_the_columns_that_a_model_takes(columns, model):
    points = torch.rand(30, columns)

    with pytest.raises(UserError, match="x, y, z, intensity, ring"):
        downsample(points, 9, model)


def test_compare_samples_with_channels(model, table, tmp_path):
    source = tmp_path / "in.npz"
    write_table(source, table)
    methods = options_by_method(9, ["fps"], str(model), None, 0)

    comparison = compare_file(source, 9, methods, 0)

    given = matrix(table, "Intensity", "ring")
    _, expected = load(model).downsample(given, 9)
    assert_array_equal(comparison.results[-1].rows, expected)


def test_registration_of_scans_refuses_channels(model):
    with pytest.raises(UserError, match="trained with the features intensity, ring, but scans"):
        ByWeights(str(model), None, [9])
