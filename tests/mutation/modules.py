"""Which tests belong to which module: few and quick ones, so that a mutant takes seconds."""

PROMISES = (
    "training/test_experiment_scores",
    "training/test_experiment_steps",
    "training/test_stages",
)
"""Tests through the real path, with a recording task net."""

TESTS: dict[str, tuple[str, ...]] = {
    "training/readouts": ("training/test_readouts", *PROMISES),
    "training/experiment": (
        "training/test_experiment",
        "training/test_experiment_scores",
        "training/test_experiment_steps",
        "training/test_recipe",
        "training/test_sizes",
    ),
    "training/scores": ("training/test_scores", "training/test_experiment_scores"),
    "training/loaders": ("training/test_loaders",),
    "training/recipe": ("training/test_recipe",),
    "training/distillation": ("training/test_distillation", "training/test_recipe"),
    "data/loader": ("data/test_loader", "training/test_loaders", "training/test_experiment_steps"),
    "samplers/base": (
        "samplers/test_contract[mops or voxel or without]",
        "samplers/test_ragged",
        "samplers/test_fmops",
    ),
    "samplers/mops": (
        "samplers/test_mops",
        "samplers/test_fused",
        "samplers/test_contract[mops]",
        "samplers/test_constructors[mops]",
    ),
    "samplers/fmops": (
        "samplers/test_fmops",
        "samplers/test_contract[fmops]",
        "samplers/test_constructors[fmops]",
    ),
    "samplers/samplenet": (
        "samplers/test_samplenet",
        "samplers/test_contract[samplenet]",
        "samplers/test_constructors[samplenet]",
    ),
    "samplers/snet": (
        "samplers/test_snet",
        "samplers/test_contract[snet]",
        "samplers/test_constructors[snet]",
    ),
    "ops/readout": ("ops/test_readout", "training/test_readouts"),
    "ops/sampling_matrix": ("ops/test_sampling_matrix", "samplers/test_mops"),
    "ops/attention": ("ops/test_attention", "ops/test_sampling_matrix", "samplers/test_streaming"),
    "losses/subset": ("losses/test_subset", "samplers/test_snet"),
    "losses/registration": ("losses/test_registration",),
    "metrics/base": ("metrics/test_base", "metrics/test_info"),
    "metrics/classification": ("metrics/test_classification", "metrics/test_base"),
    "metrics/reconstruction": ("metrics/test_reconstruction", "metrics/test_base"),
    "metrics/registration": ("metrics/test_registration", "metrics/test_base"),
    "metrics/sampled_set": ("metrics/test_sampled_set", "metrics/test_base"),
    "samplers/fps": (
        "samplers/test_fps",
        "samplers/test_contract[fps]",
        "samplers/test_constructors[fps]",
    ),
    "samplers/random": (
        "samplers/test_random",
        "samplers/test_contract[random]",
        "samplers/test_constructors[random]",
    ),
    "samplers/voxel": (
        "samplers/test_voxel",
        "samplers/test_contract[voxel]",
        "samplers/test_constructors[voxel]",
    ),
    "samplers/poisson": (
        "samplers/test_poisson",
        "ops/test_compiled",
        "samplers/test_contract[poisson]",
        "samplers/test_constructors[poisson]",
    ),
    "samplers/ordering": ("samplers/test_ordering", "samplers/test_random"),
    "samplers/fused": ("samplers/test_fused", "samplers/test_streaming"),
    "samplers/streaming": ("samplers/test_streaming",),
    "samplers/critical": (
        "samplers/test_critical",
        "samplers/test_contract[critical]",
        "samplers/test_constructors[critical]",
    ),
    "samplers/gumbel": (
        "samplers/test_gumbel",
        "samplers/test_contract[gumbel]",
        "samplers/test_constructors[gumbel]",
    ),
    "samplers/submodular": (
        "samplers/test_submodular",
        "samplers/test_contract[submodular]",
        "samplers/test_constructors[submodular]",
    ),
    "ops/facility_location": ("ops/test_facility_location",),
    "ops/chamfer": ("ops/test_chamfer",),
    "ops/emd": ("ops/test_emd",),
    "ops/assignment": ("ops/test_assignment",),
    "ops/rigid": ("ops/test_rigid",),
    "ops/compiled": ("ops/test_compiled", "ops/test_fps_cpu[compiled]"),
    "ops/elimination": ("ops/test_elimination", "ops/test_compiled[eliminate]"),
    "ops/fps_cpu": ("ops/test_fps_cpu",),
    "ops/fps": ("ops/test_fps", "ops/test_fps_cpu", "ops/test_readout"),
    "ops/nearest": ("ops/test_nearest", "ops/test_compiled"),
}
"""``FILE[WORD]``: of this file only the tests with the word in their name.

By path below ``src/mops_lightning``, in the order in which ``make mutants`` takes them. The loops
that numba compiles (``ops/kernels``, ``ops/elimination_kernels``) are not among them: a fork keeps
their compiled form, and compiling them for each mutant would take many times longer than the
tests."""
