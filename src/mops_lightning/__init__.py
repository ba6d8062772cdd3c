"""Task-oriented point cloud downsampling: MOPS-Net and the methods that it is compared with.

Public names are imported on first use, so that ``import mops_lightning`` and ``--help`` do not wait
for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mops_lightning.ops.chamfer import chamfer_distance
    from mops_lightning.ops.emd import earth_movers_distance
    from mops_lightning.ops.fps import farthest_point_sample
    from mops_lightning.ops.nearest import nearest
    from mops_lightning.ops.readout import complete, match
    from mops_lightning.ops.sampling_matrix import SamplingMatrix
    from mops_lightning.samplers.base import Sampler
    from mops_lightning.samplers.critical_points import CriticalSampler
    from mops_lightning.samplers.fmops import FMOPSNet
    from mops_lightning.samplers.fps import FPSSampler
    from mops_lightning.samplers.gumbel import GumbelSampler
    from mops_lightning.samplers.mops import MOPSNet
    from mops_lightning.samplers.poisson import PoissonSampler
    from mops_lightning.samplers.random import RandomSampler
    from mops_lightning.samplers.samplenet import ProgressiveSampleNet, SampleNet
    from mops_lightning.samplers.snet import ProgressiveSNet, SNet
    from mops_lightning.samplers.submodular import SubmodularSampler
    from mops_lightning.samplers.voxel import VoxelSampler
    from mops_lightning.types import SampleOutput
    from mops_lightning.zoo.load import load
    from mops_lightning.zoo.methods import downsample

__all__ = [
    "CriticalSampler",
    "FMOPSNet",
    "FPSSampler",
    "GumbelSampler",
    "MOPSNet",
    "PoissonSampler",
    "ProgressiveSNet",
    "ProgressiveSampleNet",
    "RandomSampler",
    "SNet",
    "SampleNet",
    "SampleOutput",
    "Sampler",
    "SamplingMatrix",
    "SubmodularSampler",
    "VoxelSampler",
    "chamfer_distance",
    "complete",
    "downsample",
    "earth_movers_distance",
    "farthest_point_sample",
    "load",
    "match",
    "nearest",
]

_MODULES = {
    "ops.chamfer": ("chamfer_distance",),
    "ops.emd": ("earth_movers_distance",),
    "ops.fps": ("farthest_point_sample",),
    "ops.nearest": ("nearest",),
    "ops.readout": ("complete", "match"),
    "ops.sampling_matrix": ("SamplingMatrix",),
    "samplers.base": ("Sampler",),
    "samplers.critical_points": ("CriticalSampler",),
    "samplers.fmops": ("FMOPSNet",),
    "samplers.fps": ("FPSSampler",),
    "samplers.gumbel": ("GumbelSampler",),
    "samplers.mops": ("MOPSNet",),
    "samplers.poisson": ("PoissonSampler",),
    "samplers.random": ("RandomSampler",),
    "samplers.samplenet": ("ProgressiveSampleNet", "SampleNet"),
    "samplers.snet": ("ProgressiveSNet", "SNet"),
    "samplers.submodular": ("SubmodularSampler",),
    "samplers.voxel": ("VoxelSampler",),
    "types": ("SampleOutput",),
    "zoo.load": ("load",),
    "zoo.methods": ("downsample",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


if not TYPE_CHECKING:  # type checkers would take every name for public

    def __getattr__(name: str) -> Any:
        """Import a public name on first use (PEP 562)."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted({*globals(), *__all__})
