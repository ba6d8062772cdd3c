"""``result.json``: what every run leaves behind, failed ones too."""

import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from mops_lightning.errors import UserError
from mops_lightning.filesystem import atomic_write
from mops_lightning.records.environment import environment
from mops_lightning.records.migrate import upgraded_config, upgraded_overrides

SCHEMA = "mops_lightning/result/1"
FILE = "result.json"


@dataclass(kw_only=True)
class RunRecord:
    """What a run records while its stages fill it in; the fields of ``result.json``.

    Attributes:
        schema: version of the schema.
        status: ``running``, ``completed``, ``failed`` or ``interrupted``.
        config: the composed configuration, interpolations resolved.
        overrides: what the user changed.
        metrics: test metrics by name.
        score: the task's main metric on the first readout.
        seconds: wall time by stage.
        seed: of the run.
        started: UTC, ISO 8601.
        versions: of Python and the packages that matter.
        platform: system and architecture.
        threads: of torch.
        git: commit of the code, and whether it was changed.
        device: name of the GPU, or kind of device.
        files: what the run wrote, by kind, relative to its folder.
        error: why the run failed or stopped.
        notes: further plain facts.
    """

    schema: str = SCHEMA
    status: str = "running"
    config: dict[str, Any]
    overrides: list[str]
    metrics: dict[str, float] = field(default_factory=dict)
    score: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    seed: int
    started: str
    versions: dict[str, str]
    platform: str
    threads: int
    git: dict[str, Any]
    device: str | None = None
    files: dict[str, str] = field(default_factory=dict)
    error: str | None = None
    notes: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def begin(cls, config: dict[str, Any], overrides: list[str], seed: int) -> "RunRecord":
        """Return the record of a run that starts now on this machine."""
        started = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(config=config, overrides=overrides, seed=seed, started=started, **environment())

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall time of the block to ``seconds``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = round(time.perf_counter() - start, 3)

    def plain(self) -> dict[str, Any]:
        """Return the record as plain data, as ``result.json`` holds it."""
        return asdict(self)


@cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of a run record."""
    text = files("mops_lightning.records").joinpath("result.schema.json").read_text()
    return json.loads(text)


def write(folder: Path, record: dict[str, Any]) -> Path:
    """Validate a record and write it as ``result.json``; NaN and infinity become null.

    Args:
        folder: the run's folder.
        record: see ``result.schema.json``.

    Raises:
        jsonschema.ValidationError: the record does not fit the schema: a bug in this program.
    """
    import jsonschema

    record = _finite(record)
    jsonschema.validate(record, schema())
    path = folder / FILE
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n")
    return path


def read(folder: Path) -> dict[str, Any]:
    """Read and validate the record in ``folder``, as plain data; settings get their present names.

    Raises:
        UserError: the folder has no ``result.json``, or it is not a run record.
    """
    import jsonschema

    path = folder / FILE
    try:
        record = json.loads(path.read_text())
        jsonschema.validate(record, schema())
        record["config"] = upgraded_config(record["config"])
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{path}: no run record. Give a run's folder.") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}.") from None
    except (ValueError, RecursionError, jsonschema.ValidationError) as error:
        reason = str(error).splitlines()[0][:200]
        raise UserError(f"{path}: not a run record: {reason}") from None
    record["overrides"] = upgraded_overrides(record["overrides"])
    return record


def dotted(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested settings under dotted keys; lists are leaves."""
    if not isinstance(tree, dict):
        return {prefix: tree}
    leaves: dict[str, Any] = {}
    for key, below in tree.items():
        leaves |= dotted(below, f"{prefix}.{key}" if prefix else str(key))
    return leaves


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
