# The public API, and the samplers that weights files may name (zoo/load.py).

from .ops.coreset import coreset as coreset
from .ops.emd import earth_movers_distance as earth_movers_distance
from .ops.flat_fps import fps as fps
from .ops.fps import farthest_point_sample as farthest_point_sample
from .ops.nearest import chamfer_distance as chamfer_distance
from .ops.nearest import nearest as nearest
from .ops.propagation import propagate as propagate
from .ops.propagation import propagation_map as propagation_map
from .ops.readout import complete as complete
from .ops.readout import match as match
from .ops.sampling_matrix import SamplingMatrix as SamplingMatrix
from .samplers.base import Sampler as Sampler
from .samplers.covariance import CovarianceSampler as CovarianceSampler
from .samplers.critical_points import CriticalSampler as CriticalSampler
from .samplers.fmops import FMOPSNet as FMOPSNet
from .samplers.fps import FPSSampler as FPSSampler
from .samplers.gumbel import GumbelSampler as GumbelSampler
from .samplers.information import InformationSampler as InformationSampler
from .samplers.mops import MOPSNet as MOPSNet
from .samplers.normal_space import NormalSpaceSampler as NormalSpaceSampler
from .samplers.poisson import PoissonSampler as PoissonSampler
from .samplers.pose import PoseSampler as PoseSampler
from .samplers.random import RandomSampler as RandomSampler
from .samplers.samplenet import ProgressiveSampleNet as ProgressiveSampleNet
from .samplers.samplenet import SampleNet as SampleNet
from .samplers.serial import SerialSampler as SerialSampler
from .samplers.snet import SNet as SNet
from .samplers.stage import StageMOPSNet as StageMOPSNet
from .samplers.steady import SteadySampler as SteadySampler
from .samplers.voxel import VoxelSampler as VoxelSampler
from .types import SampleOutput as SampleOutput
from .zoo.downsample import downsample as downsample
from .zoo.load import load as load

__all__: list[str]
