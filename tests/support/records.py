"""Made-up run records."""

from mops_lightning.records.run_record import Evaluated, RunRecord, environment

NAMES = {"task": "classification", "net": "pointnet", "dataset": "shapes", "sampler": "mops"}
CONFIG = {
    "m": 32,
    "learn": "sampler",
    "names": NAMES,
    "task": {},
    "dataset": {},
    "sampler": {},
    "trainer": {"max_epochs": 3},
}


def record(config=None, **changes):
    return RunRecord(
        **{
            "status": "completed",
            "config": {**CONFIG, **(config or {})},
            "overrides": ["m=32"],
            "metrics": {"test/generated/accuracy": 0.5},
            "score": 0.5,
            "seconds": {"total": 1.0},
            "seed": 0,
            "started": "2026-01-01T00:00:00+00:00",
            **environment(),
            "git": {"commit": "0123456789" * 4, "dirty": False},
            "device": "cpu",
            **changes,
        }
    )


def evaluated(**changes):
    values = {"run": "run", "commit": "c", "max_epochs": 9, "learn": "sampler", "seed": 0}
    return Evaluated(**{**values, "dataset": "shapes", "weights_sha256": "w", **changes})
