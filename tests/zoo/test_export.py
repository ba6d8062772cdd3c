from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning import FMOPSNet, FPSSampler, MOPSNet, SampleNet, SNet, load
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.zoo.export import GeneratedPoints, export

SMALL: dict[str, Any] = {"feature_channels": (8, 8), "rho_channels": (16, 8)}
SMALL_SNET: dict[str, Any] = {"feature_channels": (8, 8), "head_channels": (8,)}
SIZES = ((1, 12), (4, 100), (2, 257))


def clouds(number, points):
    rng = torch.Generator().manual_seed(points)
    return torch.rand(number, points, 3, generator=rng) - 0.5


@pytest.mark.parametrize(
    ("sampler", "m"),
    [
        (MOPSNet(8, **SMALL), None),
        (FMOPSNet(12, **SMALL), 5),
        (SNet(8, **SMALL_SNET), None),
        (SNet(8, head_norm=False, **SMALL_SNET), None),
        (SampleNet(8, output_norm=False, **SMALL_SNET), None),
    ],
    ids=lambda value: type(value).__name__,
)
def test_exported_program_equals_the_sampler_at_any_size(sampler, m, tmp_path):
    sampler(clouds(4, 50)).points.sum()  # running statistics
    sampler.eval()

    export(sampler, tmp_path / "net.pt2", m)

    program = torch.export.load(tmp_path / "net.pt2").module()
    with torch.no_grad():
        for shape in SIZES:
            points = clouds(*shape)
            expected = sampler(points, m).points
            assert torch.allclose(program(points), expected, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 2**20), (40, 2**15)])
def test_exported_program_takes_more_points_than_s_has_entries_in_one_piece(shape, tmp_path):
    sampler = MOPSNet(8, **SMALL).eval()
    points = clouds(*shape)

    export(sampler, tmp_path / "net.pt2")

    with torch.no_grad():
        program = torch.export.load(tmp_path / "net.pt2").module()
        expected = sampler(points).points
        assert torch.allclose(program(points), expected, atol=1e-5)


def test_onnx_file_equals_the_model_at_any_size(tmp_path):
    pytest.importorskip("onnxscript", reason="extra onnx")
    onnxruntime = pytest.importorskip("onnxruntime", reason="extra onnx")
    sampler = load("mops.modelnet40-m32")

    difference = export(sampler, tmp_path / "net.onnx")

    assert difference < 1e-5
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx")
    for shape in ((1, 32), (4, 100), (2, 257)):
        points = clouds(*shape)
        (generated,) = session.run(["generated"], {"points": points.numpy()})
        with torch.no_grad():
            expected = sampler(points).points
        assert np.allclose(generated, expected.numpy(), atol=1e-5)


def anchored(**columns):
    """Return an FMOPS-Net for up to 12 points whose weights are all moved away from their start."""
    torch.manual_seed(0)
    sampler = FMOPSNet(12, anchors="fps", **columns, **SMALL)
    for weights in sampler.queries.parameters():
        torch.nn.init.normal_(weights, std=0.3)
    sampler(clouds(4, 150)).points.sum()  # running statistics
    return sampler.eval()


@pytest.mark.parametrize(
    ("columns", "least"),
    [
        ({}, 64),
        ({"candidates": 8, "neighbours": 6}, 96),
        ({"candidates": 5}, 64),
        ({"neighbours": 70}, 70),
    ],
    ids=str,
)
def test_exported_anchored_program_equals_the_sampler_from_the_least_number(
    columns, least, tmp_path
):
    sampler = anchored(**columns)

    export(sampler, tmp_path / "net.pt2", 5)

    program = torch.export.load(tmp_path / "net.pt2").module()
    with torch.no_grad():
        for shape in ((1, least), (3, 200)):
            points = clouds(*shape)
            expected = sampler(points, 5).points
            assert torch.allclose(program(points), expected, atol=1e-5)
    with pytest.raises(AssertionError, match=f"points.*>= {least}"):
        program(clouds(1, least - 1))


@pytest.fixture(scope="module")
def local_columns(tmp_path_factory):
    """An FMOPS-Net with local columns, and a session with its ONNX file for 5 points."""
    pytest.importorskip("onnxscript", reason="extra onnx")
    onnxruntime = pytest.importorskip("onnxruntime", reason="extra onnx")
    sampler = anchored(candidates=8, neighbours=6)
    path = tmp_path_factory.mktemp("onnx") / "net.onnx"
    export(sampler, path, 5)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # a refusal is also logged
    return sampler, onnxruntime.InferenceSession(path, options)


def test_onnx_file_names_its_axes(local_columns):
    _, session = local_columns

    (points,) = session.get_inputs()
    (generated,) = session.get_outputs()

    assert (points.name, points.shape) == ("points", ["batch", "points", 3])
    assert (generated.name, generated.shape) == ("generated", ["batch", 5, 3])


def test_onnx_file_of_local_columns_equals_the_sampler_and_refuses_too_few_points(local_columns):
    sampler, session = local_columns

    for shape in ((1, 96), (3, 200)):
        points = clouds(*shape)
        (generated,) = session.run(["generated"], {"points": points.numpy()})
        with torch.no_grad():
            expected = sampler(points, 5).points
        assert np.allclose(generated, expected.numpy(), atol=1e-5)
    with pytest.raises(Exception, match="Out of range value in index tensor"):
        session.run(["generated"], {"points": clouds(1, 95).numpy()})


def test_sampler_that_is_not_learned_is_not_exported(tmp_path):
    with pytest.raises(UserError, match="FPSSampler cannot be exported"):
        export(FPSSampler(8).eval(), tmp_path / "net.onnx")
    assert not list(tmp_path.iterdir())


CHANNELS = PointChannels(
    [
        Channel("intensity"),
        Channel("normal_x"),
        Channel("normal_y"),
        Channel("normal_z"),
    ]
)


@pytest.mark.parametrize(
    ("sampler", "width"),
    [
        (MOPSNet(8, point_channels=CHANNELS, **SMALL), 7),
        (FMOPSNet(8, point_channels=CHANNELS, **SMALL), 7),
        (SNet(8, point_channels=CHANNELS, **SMALL_SNET), 3),
    ],
    ids=lambda value: type(value).__name__,
)
def test_exported_program_takes_channels(sampler, width, tmp_path):
    coordinates = clouds(2, 50)
    normals = clouds(2, 51)[:, :50]
    intensity = clouds(2, 52)[:, :50, :1]
    points = torch.cat([coordinates, normals, intensity], dim=2)
    points = CHANNELS.renormalised(points)
    sampler.eval()

    export(sampler, tmp_path / "net.pt2")

    program = torch.export.load(tmp_path / "net.pt2").module()
    with torch.no_grad():
        generated = program(points)
        expected = sampler(points).points[..., :width]
        assert generated.shape == (2, 8, width)
        assert torch.allclose(generated, expected, atol=1e-5)


@pytest.mark.parametrize("suffix", [".pt2", ".onnx"])
def test_program_that_differs_from_its_sampler_is_not_written(suffix, tmp_path, monkeypatch):
    if suffix == ".onnx":
        pytest.importorskip("onnxscript", reason="extra onnx")
    sampler = MOPSNet(8, **SMALL).eval()
    right = GeneratedPoints.forward
    monkeypatch.setattr(GeneratedPoints, "forward", lambda self, points: right(self, points) + 0.01)

    said = r"points differ from the sampler's by up to 1\.0e-02, more than 1e-05; nothing was"
    with pytest.raises(UserError, match=said):
        export(sampler, tmp_path / f"net{suffix}")

    assert list(tmp_path.iterdir()) == []


def test_program_is_compared_at_many_points_and_several_clouds(tmp_path, monkeypatch):
    sampler = MOPSNet(8, **SMALL).eval()
    seen = []
    forward = MOPSNet.forward

    def note(self, points, m=None):
        seen.append(tuple(points.shape))
        return forward(self, points, m)

    monkeypatch.setattr(MOPSNet, "forward", note)

    export(sampler, tmp_path / "net.pt2")

    assert seen == [(1, 13, 3), (3, 21, 3), (2, 61, 3), (1, 65536, 3)]
