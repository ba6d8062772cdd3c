"""Numbers that results depend on: constants of modules, and defaults of public functions.

Defaults that files of ``conf/`` repeat are compared in ``config/test_defaults``.
"""

from importlib import import_module
from inspect import Parameter, signature
from operator import attrgetter

import pytest

CONSTANTS = """
metrics.info: DEFAULT_ORDER=10
metrics.sampled_set: NONZERO_THRESHOLD=0.01
nets.autoencoder: DECODER_CHANNELS=(256,256)
nets.foldingnet: REACH=0.3
nets.pcrnet: HEAD_CHANNELS=(1024,1024,512,512,256)
nets.plane_icp: DAMPING=1e-06
ops.coreset: LEAST=29
ops.farthest: FARTHEST='farthest' LEAST_FACTOR=1e-200
ops.neighbourhoods: SCALES=(6,12,24) PLANE=12 LEAST=0.01 FEATURES=28
ops.normals: NEIGHBOURS=12
ops.propagation: CLOSE=1e-08
ops.readout: READOUTS=('generated','matched','completed')
ops.stability: PRIOR=0.001 RIDGE=0.01 CELLS=5
ops.voxels: MOST=67108864 FARTHEST=4503599627370496.0
ops.weights: NEIGHBOURS=16 LEAST=0.001 CURVATURE='curvature'
samplers.anchors: SPACING_POINTS=64 SMALLEST=0.001
samplers.by_budget: MOST=2147483647
samplers.gumbel: KEY_CHANNELS=(256,128)
samplers.mops: DEFAULT_WIDTH=0.5 MAX_WIDTH=100
samplers.own_frame: FRAME_POINTS=4 LEAST_WIDTH=1e-05
samplers.pose: TRAINED_SIZE=32 LARGEST=15.0
samplers.serial: BITS=21
samplers.tiles: EXTRA=1.25
samplers.voxel: COARSEST=-1.0 FINEST=20.0 BISECTIONS=24
tasks.reconstruction: TRAINED_BLOCK=32 TRAINED_ROUNDS=1 SCORED_BLOCK=128 SCORED_ROUNDS=8
tasks.registration: ROTATION=45.0 TRANSLATION=1.0
tasks.scan_registration: MOTIONS=4
viz.figures: MATRIX_ROWS=256 LARGE_MARKER_SAMPLES=256 MAX_INPUT_POINTS=8192
viz.figures: INPUT_COLOUR=(190,190,190)
viz.task_results: SOURCE_COLOUR=(0.12,0.47,0.86) TARGET_COLOUR=(0.84,0.3,0.05) SAMPLE_SIZE=14
"""

DEFAULTS = """
losses.subset.simplification_losses: coverage=1.0 coverage_per_point=0.0
nets.autoencoder.PointEncoder: codeword=128 channels=(64,128,128,256)
nets.layers.PointMLP: norm=True
nets.layers.linear_norm_relu: norm=True
nets.max_pool.PointMaxPool: norm=True
ops.coreset.coreset: normals=None max_distance=inf
ops.emd.earth_movers_distance: block=None rounds=4 workers=1
ops.emd.solve_assignments: block=None rounds=4 workers=1
ops.flat_fps.fps: batch=None ratio=0.5 random_start=True batch_size=None
ops.fps.farthest_point_sample: start=0 weight=None
ops.local_matrix.LocalMatrix.nonzero_counts: threshold=0.01
ops.local_matrix.LocalMatrix.sparse: threshold=0.01
ops.normals.estimate_normals: neighbours=12
ops.propagation.interpolate: k=3
ops.propagation.propagate: mean=False fill=None
ops.propagation.propagation_map: k=1 batch=None sampled_batch=None
ops.sampling_matrix.SamplingMatrix.nonzero_counts: threshold=0.01
ops.sampling_matrix.SamplingMatrix.sparse: threshold=0.01
ops.spacing.keep_spaced: seed=0 weight=None
samplers.base.Sampler.downsample: m=None readout='completed' batch=None weight=None
samplers.base.Sampler.forward: m=None
samplers.base.stream_sample: m=None
viz.figures.save_figure: dpi=110 software=''
"""


@pytest.mark.parametrize("line", CONSTANTS.strip().splitlines())
def test_constants_have_their_values(line):
    name, values = line.split(": ")
    module = import_module(f"mops_lightning.{name}")

    for text in values.split():
        constant, _, value = text.partition("=")
        assert as_text(getattr(module, constant)) == value, constant


@pytest.mark.parametrize("line", DEFAULTS.strip().splitlines())
def test_public_functions_have_these_defaults(line):
    name, defaults = line.split(": ")
    room, module, function = name.split(".", 2)
    found = attrgetter(function)(import_module(f"mops_lightning.{room}.{module}"))

    given = []
    for argument in signature(found).parameters.values():
        if argument.default is not Parameter.empty and argument.name != "point_channels":
            given.append(f"{argument.name}={as_text(argument.default)}")

    assert given == defaults.split()


def as_text(value: object) -> str:
    return repr(value).replace(" ", "")
