"""Export of learned samplers: torch.export (.pt2) and ONNX (.onnx)."""

import io
import logging
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mops_lightning.channels import PointChannels
from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write
from mops_lightning.ops.sampling_matrix import SamplingMatrix
from mops_lightning.samplers.anchors import FPSAnchors
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.samplers.snet import SNet

SUFFIXES = (".onnx", ".pt2")
TOLERANCE = 1e-5
"""Largest difference between points of the file and of the sampler, in the unit sphere."""
CHECKED = ((1, 1), (3, 2), (2, 7))
"""Numbers of clouds, and of points as multiples of the least number, for comparisons."""
MANY = 2**23
"""Number of points times m at which a file is compared as well: more than S has in one piece."""
MOST_POINTS = 2**16
"""Largest number of points in this comparison."""
UPWARDS = 3.0
"""Added to the z of random normals: means of normals in all directions would have none."""
AXES = ("batch", "points")
"""Names of the axes of the input that have any size."""


class GeneratedPoints(nn.Module):
    """A learned sampler as a net from points to generated points.

    Maps ``(B, N, 3 + C)`` points, in the unit sphere and with scaled channels, to
    ``(B, m, 3 + C)``; S-Net and SampleNet, which generate coordinates only, to ``(B, m, 3)``.

    Args:
        sampler: trained, in eval mode.
        m: number of points; None means ``sampler.m``.

    Raises:
        UserError: the sampler has no weights, selects input points, or does not return m points.
    """

    def __init__(self, sampler: Sampler, m: int | None = None) -> None:
        super().__init__()
        if m is None:
            m = sampler.m
        self.m = m
        sampler.check_m(self.m)
        if not isinstance(sampler, MOPSNet | SNet):
            raise UserError(
                f"{type(sampler).__name__} cannot be exported. MOPS-Net, FMOPS-Net, S-Net and "
                "SampleNet can."
            )
        self.sampler = sampler

    @property
    def least_points(self) -> int:
        """How many points a cloud must have."""
        if not isinstance(self.sampler, MOPSNet):
            return 1
        if not isinstance(self.sampler.queries, FPSAnchors):
            return 1
        return self.sampler.queries.least_points(self.m)

    def forward(self, points: Tensor) -> Tensor:
        """Return the generated points."""
        if isinstance(self.sampler, MOPSNet) and not self.sampler.threshold:
            matrix = self.sampler.sampling_matrix(points, self.m)
            if isinstance(matrix, SamplingMatrix):
                # Blocks of S for many points would limit the number of points of the program.
                sampled = matrix.sample_dense(points)
            else:
                sampled = matrix.sample(points)
            return self.sampler.point_channels.renormalised(sampled)
        return self.sampler.sample(points, self.m).points


def export(sampler: Sampler, path: Path, m: int | None = None) -> float:
    """Write a sampler as a program that runs without this package, and compare both.

    Input ``points`` are ``(batch, points, 3 + C)`` float32, in the unit sphere and with channels
    scaled as in training, with any number of clouds and points; output ``generated`` is
    ``(batch, m, 3 + C)``, of S-Net and SampleNet ``(batch, m, 3)``. With ``anchors=fps`` clouds
    must have at least ``GeneratedPoints.least_points`` points; the lowest row wins ties of
    farthest points.

    Args:
        sampler: trained, in eval mode.
        path: ends in ``.onnx`` or ``.pt2``.
        m: number of points; None means ``sampler.m``.

    Returns:
        The largest difference between the points of the file and of the sampler.

    Raises:
        UserError: the sampler cannot be exported, the extra ``onnx`` is not installed, or the
            points differ by more than ``TOLERANCE``.
    """
    if path.suffix not in SUFFIXES:
        raise UserError(f"OUT must end in {' or '.join(SUFFIXES)}, got {path}.")
    net = GeneratedPoints(sampler, m)
    with torch.no_grad(), atomic_write(path) as temporary:
        program = _traced(net)
        if path.suffix == ".pt2":
            exported = _to_pt2(program, temporary)
        else:
            exported = _to_onnx(program, temporary)
        differences = []
        for points in _clouds(net.m, max(net.m, net.least_points), sampler.point_channels):
            differences.append(_difference(exported, sampler, net.m, points))
        difference = max(differences)
        if difference > TOLERANCE:
            raise UserError(
                f"{path}: its points differ from the sampler's by up to {difference:.1e}, more "
                f"than {TOLERANCE:.0e}; nothing was written. Export in the other format."
            )
    return difference


def _traced(net: GeneratedPoints) -> Any:
    """Return the program of a sampler for any number of clouds and points."""
    width = 3 + len(net.sampler.point_channels)
    number = 2 * max(net.m, net.least_points) + 3
    rng = torch.Generator().manual_seed(0)
    example = torch.rand(2, number, width, generator=rng)
    batch, points = AXES
    axes = {
        0: torch.export.Dim(batch),
        1: torch.export.Dim(points, min=max(net.least_points, 2)),
    }
    return torch.export.export(net, (example,), dynamic_shapes=(axes,))


def _to_pt2(program: Any, path: Path) -> Callable[[Tensor], Tensor]:
    """Write a program in torch's format and return the function of the file."""
    packed = io.BytesIO()  # on a full disk, torch would abort the process
    torch.export.save(program, packed)
    path.write_bytes(packed.getvalue())
    exported: Callable[[Tensor], Tensor] = torch.export.load(path).module()
    return exported


def _difference(
    exported: Callable[[Tensor], Tensor], sampler: Sampler, m: int, points: Tensor
) -> float:
    """Return the largest difference of a program's points from the sampler's."""
    generated = exported(points)
    expected = sampler(points, m).points[..., : generated.shape[-1]]
    return float((generated - expected).abs().max())


def _clouds(m: int, least: int, channels: PointChannels) -> Iterable[Tensor]:
    """Yield random clouds in the unit sphere; their normals point upwards, as on a surface.

    Args:
        m: number of points that are generated.
        least: smallest number of points of a cloud.
        channels: of the points.
    """
    rng = torch.Generator().manual_seed(1)
    many = max(min(MANY // m + 1, MOST_POINTS), least)
    shapes = [(clouds, times * least + 5) for clouds, times in CHECKED]
    for clouds, number in [*shapes, (1, many)]:
        points = torch.randn(clouds, number, 3, generator=rng)
        radii = points.norm(dim=2).amax(1)
        points = points / radii[:, None, None]
        if channels:
            values = torch.randn(clouds, number, len(channels), generator=rng)
            points = torch.cat([points, values], 2)
        if channels.normals is not None:
            points[..., channels.normals + 2] += UPWARDS
        yield channels.renormalised(points)


def _to_onnx(program: Any, path: Path) -> Callable[[Tensor], Tensor]:
    """Write a program as ONNX and return the function of the file."""
    try:
        import onnxruntime
        import onnxscript  # noqa: F401, torch.onnx needs it
    except ModuleNotFoundError:
        raise UserError(".onnx files need an extra: pip install 'mops-lightning[onnx]'.") from None
    # It warns that torchvision, which is not needed, is missing.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        # torch 2.13 uses a class name that it has deprecated.
        warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.*", FutureWarning)
        torch.onnx.export(
            program,
            (),
            path,
            input_names=["points"],
            dynamic_shapes=[dict(enumerate(AXES))],
            output_names=["generated"],
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def exported(points: Tensor) -> Tensor:
        (generated,) = session.run(None, {"points": points.numpy()})
        return torch.from_numpy(generated)

    return exported
