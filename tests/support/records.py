"""Made-up run records."""

from typing import Any

from mops_lightning.records.run_record import Evaluated, RunRecord, environment

NAMES = {"task": "classification", "net": "pointnet", "dataset": "shapes", "sampler": "mops"}
CONFIG: dict[str, Any] = {"m": 32, "learn": "sampler", "names": NAMES, "task": {}, "dataset": {}}
CONFIG |= {"sampler": {}, "trainer": {"max_epochs": 3}}


def record(config=None, **changes):
    values: dict[str, Any] = {"status": "completed", "config": {**CONFIG, **(config or {})}}
    values |= {"overrides": ["m=32"], "metrics": {"test/generated/accuracy": 0.5}, "score": 0.5}
    values |= {"seconds": {"total": 1.0}, "seed": 0, "started": "2026-01-01T00:00:00+00:00"}
    return RunRecord(**{**values, **environment(), "device": "cpu", **changes})


def evaluated(**changes):
    values = {"run": "run", "commit": "c", "max_epochs": 9, "learn": "sampler", "seed": 0}
    return Evaluated(**{**values, "dataset": "shapes", "weights_sha256": "w", **changes})
