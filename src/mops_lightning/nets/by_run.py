"""What a run gives to its task net."""

BY_RUN = (
    "n_points",
    "sampler.m",
    "sampler.m_max",
    "sampler.seed",
)
"""Settings of a task net that follow the run's, or that its stages have for themselves."""
