"""``result.json``: what every run leaves behind, failed ones too."""

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import msgspec

from mops_lightning.errors import UserError, printable
from mops_lightning.filesystem import atomic_write
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.digest import digest_of

SCHEMA: Literal["mops_lightning/result/2"] = "mops_lightning/result/2"
FILE = "result.json"
MANY = "runs.jsonl"
"""File with the records of several runs, one a line."""
ASIDE = ".attempts"
"""Folder with the earlier attempts of a sweep's cell."""
MAX_DEPTH = 50
"""Deepest nesting of a record that is read."""
FAILED = ".failed"
"""File in a cell's folder that says why its last start failed, with or without a record."""
PACKAGES = (
    "mops-lightning",
    "torch",
    "lightning",
    "hydra-core",
    "torchmetrics",
    "trimesh",
    "numpy",
)
"""Packages whose versions are recorded."""


class Names(TypedDict):
    """Names of a run's groups."""

    task: str
    net: str
    dataset: str
    sampler: str


class TaskSettings(TypedDict, total=False):
    """Settings of a task."""

    net: dict[str, Any] | None


class DatasetSettings(TypedDict, total=False):
    """Settings of a data set."""

    n_points: int | None


class TrainerSettings(TypedDict):
    """Settings of a trainer."""

    max_epochs: int | None


class Configuration(TypedDict):
    """The settings that tables read; a configuration has more."""

    names: Names
    learn: str
    m: int
    task: TaskSettings
    dataset: DatasetSettings
    sampler: dict[str, Any]
    trainer: TrainerSettings
    baselines: NotRequired[dict[str, dict[str, Any] | None] | None]


class Git(TypedDict):
    """The commit of the code, and whether it was changed; None outside of a checkout."""

    commit: str | None
    dirty: bool | None


@dataclass(kw_only=True)
class Evaluated:
    """The run that ``evaluate=RUN`` tests, and how it was trained.

    Attributes:
        run: its folder, or the name of a model.
        commit: of the code that trained it.
        max_epochs: for which it was trained.
        learn: what it trained.
        recipe: as in ``RunRecord``.
        seed: of its training.
        dataset: name of its data.
        weights_sha256: of the tested weights.
    """

    run: str
    commit: str | None
    max_epochs: int | None
    learn: str
    recipe: dict[str, Any] | None = None
    seed: int
    dataset: str
    weights_sha256: str


@dataclass(kw_only=True)
class RunRecord:
    """The fields of ``result.json``, which the stages of a run fill in.

    Attributes:
        schema: version of the schema.
        status: ``running``, ``completed``, ``failed`` or ``interrupted``.
        config: the composed configuration, interpolations resolved.
        overrides: what the user changed.
        metrics: test metrics by name; None in a file where the value was not finite.
        score_name: name of the task's main metric on the first readout, among ``metrics``.
        score: its value.
        collapsed: sizes at which fewer than half of the matched points are distinct, with the mean
            number of distinct ones; such a score says nothing of the sample as a sample.
        metric_info: label, unit, direction of metrics that are not this package's.
        validation: metrics of the held-out clouds after the last epoch.
        seconds: wall time by stage; ``fit_cpu``: CPU time of the training, all attempts together.
        partial: what the run left out, such as "tested on 1 of 4 batches"; empty for a full run.
        seed: of the run.
        started: UTC, ISO 8601.
        versions: of Python and the packages that matter.
        platform: system and architecture.
        threads: of torch.
        git: commit of the code, and whether it was changed.
        device: name of the GPU, or kind of device.
        files: what the run wrote, by kind, relative to its folder.
        error: why the run failed or stopped.
        dataset_fingerprint: changes with the content of the data.
        train_clouds: number of training clouds.
        test_clouds: number of test clouds.
        class_names: of the data.
        part_names: of the data; empty without parts.
        dataset_facts: what the data set tells, such as the number of skipped meshes.
        parameters: their numbers by part: ``task``, ``sampler``.
        processes: that trained together.
        recipe: how the sampler was trained, with its name; None: the paper's.
        warm_start: number of copied layers or tensors, and the sha256 of the file they are from.
        weights_loaded: sha256 of the file that the task net was loaded from.
        task_weights_sha256: of the task net that was tested, unless the run trained it.
        resumed_from: the checkpoint that the training continued from.
        lengthened: whether it continued with another number of epochs than planned.
        evaluated: the run that was tested; None: this one.
        folder: of the run, relative to the file that holds the record.
        digest: of the other fields, as the program wrote them; None in records of earlier versions.
    """

    schema: Literal["mops_lightning/result/2"] = SCHEMA
    status: Literal["running", "completed", "failed", "interrupted"] = "running"
    config: dict[str, Any]
    overrides: list[str]
    metrics: dict[str, Any] = field(default_factory=dict)
    score_name: str = ""
    score: float | None = None
    collapsed: dict[str, float] = field(default_factory=dict)
    metric_info: dict[str, dict[str, Any]] = field(default_factory=dict)
    validation: dict[str, float | None] = field(default_factory=dict)
    seconds: dict[str, Annotated[float, msgspec.Meta(ge=0)]] = field(default_factory=dict)
    partial: list[str] = field(default_factory=list)
    seed: Annotated[int, msgspec.Meta(ge=0)]
    started: str
    versions: dict[str, str]
    platform: str
    threads: Annotated[int, msgspec.Meta(ge=1)]
    git: Git
    device: str | None = None
    files: dict[str, str] = field(default_factory=dict)
    error: str | None = None
    dataset_fingerprint: str | None = None
    train_clouds: int | None = None
    test_clouds: int | None = None
    class_names: list[str] | None = None
    part_names: list[str] | None = None
    dataset_facts: dict[str, Any] = field(default_factory=dict)
    parameters: dict[str, int] = field(default_factory=dict)
    processes: int | None = None
    recipe: dict[str, Any] | None = None
    warm_start: dict[str, Any] | None = None
    weights_loaded: str | None = None
    task_weights_sha256: str | None = None
    resumed_from: str | None = None
    lengthened: bool = False
    evaluated: Evaluated | None = None
    folder: str = "."
    digest: str | None = None

    @classmethod
    def begin(cls, config: dict[str, Any], overrides: list[str], seed: int) -> "RunRecord":
        """Return the record of a run that starts now on this machine."""
        started = datetime.now(UTC).isoformat(timespec="seconds")
        facts = environment()
        return cls(config=config, overrides=overrides, seed=seed, started=started, **facts)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the wall time of the block to ``seconds``."""
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[stage] = round(elapsed, 3)

    def plain(self) -> dict[str, Any]:
        """Return the record as plain data, as ``result.json`` holds it."""
        return asdict(self)

    @property
    def is_edited(self) -> bool:
        """Whether the record was changed after it was written; False for one without a digest."""
        if self.digest is None:
            return False
        return self.digest != digest_of(_finite(self.plain()))


def from_plain(plain: Any) -> RunRecord:
    """Return a record from plain data, such as the content of ``result.json``.

    Raises:
        ValueError: it does not fit the types of ``RunRecord`` and the settings that tables read.
    """
    record = msgspec.convert(plain, RunRecord)
    known = {declared.name for declared in fields(RunRecord)}
    unknown = sorted(plain.keys() - known)
    if unknown:
        raise ValueError(f"unknown: {', '.join(unknown)}")
    msgspec.convert(record.config, Configuration)
    msgspec.convert(record.metrics, dict[str, float | None])
    for name, values in record.metric_info.items():
        msgspec.convert({**values, "name": name}, MetricInfo)
    return record


def write(folder: Path, record: RunRecord) -> Path:
    """Check a record and write it as ``result.json``; NaN and infinity become null.

    Raises:
        ValueError: the record does not fit its types: a bug in this program.
    """
    plain = from_plain(_finite(record.plain())).plain()
    plain["digest"] = digest_of(plain)
    path = folder / FILE
    with atomic_write(path) as temporary:
        text = json.dumps(plain, indent=1, allow_nan=False)
        temporary.write_text(text + "\n")
    return path


def write_many(path: Path, records: Iterable[RunRecord]) -> None:
    """Write records to one file, one a line; their folders become relative to its own."""
    with atomic_write(path) as temporary, temporary.open("w") as file:
        for record in records:
            relative = os.path.relpath(record.folder, path.parent)
            folder = Path(relative).as_posix()
            plain = _finite(replace(record, folder=folder).plain())
            file.write(json.dumps(plain, allow_nan=False) + "\n")


def read(folder: Path) -> RunRecord:
    """Read and validate the record in ``folder``.

    Raises:
        UserError: the folder has no ``result.json``, or it is not a run record.
    """
    path = folder / FILE
    if not path.is_file():  # reading a named pipe would wait forever
        raise UserError(f"{path}: no run record. Give a run's folder.")
    return from_json(path.read_text(errors="replace"), str(path))


def from_json(text: str, place: str) -> RunRecord:
    """Return the record in a JSON text.

    Args:
        text: the content of ``result.json``, or a line of ``runs.jsonl``.
        place: the file, for errors.

    Raises:
        UserError: it is not a run record.
    """
    try:
        plain = json.loads(text)  # msgspec's decoder refuses names that are no text
        _check_extent(plain, MAX_DEPTH)
        return from_plain(plain)
    except (ValueError, RecursionError) as error:
        first_line = str(error).splitlines()[0]
        reason = printable(first_line[:200])
        raise UserError(f"{place}: not a run record: {reason}") from None


def _check_extent(plain: Any, deepest: int) -> None:
    """Check that nothing is nested too deeply, and that a float can hold every number."""
    if deepest < 0:
        raise ValueError(f"nested more than {MAX_DEPTH} levels deep")
    if isinstance(plain, int) and abs(plain) > sys.float_info.max:
        raise ValueError("Number out of range")
    items: Iterable[Any] = ()
    if isinstance(plain, dict):
        items = plain.values()
    if isinstance(plain, list):
        items = plain
    for item in items:
        _check_extent(item, deepest - 1)


def _finite(plain: dict[str, Any]) -> dict[str, Any]:
    """Return plain data as JSON holds it, with None for NaN and infinity."""
    return json.loads(json.dumps(plain), parse_constant=lambda name: None)


def environment() -> dict[str, Any]:
    """Return versions, machine and the commit of the code, as plain data."""
    import torch

    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        versions[name] = version(name)
    return {
        "versions": versions,
        "platform": f"{platform.system()} {platform.machine()}",
        "threads": torch.get_num_threads(),
        "git": git_state(),
    }


def git_state() -> dict[str, Any]:
    """Return the commit of the checkout that this package runs from, and whether it has changes.

    Both are None for an installed wheel.
    """
    here = Path(__file__).resolve().parent
    top = here.parents[2]
    if not (top / ".git").exists():
        return {"commit": None, "dirty": None}
    try:
        commit = _git(top, "rev-parse", "HEAD")
        dirty = _git(top, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return {"commit": None, "dirty": None}
    return {"commit": commit, "dirty": bool(dirty)}


def _git(top: Path, *arguments: str) -> str:
    command = ["git", "-C", str(top), *arguments]
    finished = subprocess.run(command, check=True, capture_output=True, text=True)
    return finished.stdout.strip()
