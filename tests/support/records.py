"""Made-up run records."""

from mops_lightning.records import run_record
from mops_lightning.records.environment import environment


def record(**changes):
    return {
        "schema": run_record.SCHEMA,
        "status": "completed",
        "config": {"m": 32},
        "overrides": ["m=32"],
        "metrics": {"test/generated/accuracy": 0.5},
        "score": 0.5,
        "seconds": {"total": 1.0},
        "seed": 0,
        "started": "2026-01-01T00:00:00+00:00",
        **environment(),
        "device": "cpu",
        "files": {},
        "error": None,
        "notes": {},
        **changes,
    }
