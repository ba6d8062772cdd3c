"""The rows of tables: their names and their order."""

import math
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mops_lightning.records.readout_names import (
    FULL,
    GENERATED_READOUTS,
    INDEX_READOUT,
    PROJECTED,
    parse_metric_name,
)
from mops_lightning.records.run_record import RunRecord
from mops_lightning.records.summary import baseline_name
from mops_lightning.report import collect
from mops_lightning.report.comparable import considered
from mops_lightning.tree import dotted

READOUTS = (INDEX_READOUT, *GENERATED_READOUTS, PROJECTED)
"""Readouts of a cell, in its order."""

ORDER = (
    "random",
    "serial",
    "voxel",
    "fps",
    "poisson",
    "normal_space",
    "covariance",
    "information",
    "steady",
    "pose",
    "critical",
    "submodular",
    "gumbel",
    "snet",
    "samplenet",
    "samplenet_progressive",
    "mops",
    "fmops",
)
"""Samplers in the order of the paper's tables; others follow by name."""

NUMBER = re.compile(r"((?<==)[-+.e0-9]+)")
"""A number behind an equals sign in the name of a row."""

SAMPLER = "sampler."
"""Start of the dotted settings that are arguments of the sampler."""

TARGET = "_target_"
"""The setting that names a class."""

NOT_IN_NAMES = ("m", "seed")
"""Arguments of a sampler that do not give it a row of its own: its runs are cells of one row."""


class RowNames:
    """The names of a table's rows.

    A row is a sampler with its recipe. If two runs of it would share a cell though their samplers
    differ, the arguments in which they differ are part of the name: an FMOPS-Net for up to 128
    points and one for up to 512 are ``fmops m_max=128`` and ``fmops m_max=512``. So are other
    settings in which two runs of one seed differ, such as the learning rates of trials.

    Args:
        records: of the table, each with a folder of its own.
        net: the table's task net; results under other nets get separate rows. Empty: of all nets.
        columns: dotted settings that have columns of their own.
    """

    def __init__(self, records: Sequence[RunRecord], net: str, columns: Sequence[str] = ()) -> None:
        self.net = net
        self._names: dict[str, str] = {}
        rows: dict[str, list[RunRecord]] = defaultdict(list)
        for record in records:
            rows[_on_net(record, net)].append(record)
        for name, of_row in rows.items():
            keys = _telling_apart(of_row, columns)
            apart = [*columns, *(SAMPLER + key for key in keys)]
            of_training = _of_training(of_row, apart, are_of_one_net=bool(net))
            classes = {_class_of_sampler(record) for record in of_row}
            for record in of_row:
                words = [name, *_texts(record, keys, classes)]
                words += _texts_of_training(record, of_training)
                self._names[record.folder] = " ".join(words)

    def of(self, record: RunRecord) -> str:
        """Return the row of a record's own results."""
        return self._names[record.folder]

    def of_readout(self, record: RunRecord, readout: str) -> str:
        """Return the row of a value: its run's sampler, or a baseline of the run."""
        if readout in (*READOUTS, FULL):
            return self.of(record)
        whole = _on_net(record, self.net)
        on_net = whole.removesuffix(collect.sampler_row(record))
        return on_net + baseline_name(record.config, readout)  # such as "dgcnn on fps"


def _class_of_sampler(record: RunRecord) -> str:
    sampler = record.config["sampler"] or {}
    return str(sampler.get(TARGET))


def _on_net(record: RunRecord, net: str) -> str:
    """Return a record's sampler, with its task net unless it is the table's."""
    own = collect.names(record)["net"]
    sampler = collect.sampler_row(record)
    if net in ("", own):
        return sampler
    return f"{own} on {sampler}"


def _telling_apart(records: Sequence[RunRecord], columns: Sequence[str]) -> list[str]:
    """Return the arguments of a row's samplers in which runs for one cell differ."""
    own = [key.removeprefix(SAMPLER) for key in columns]
    cells: dict[Any, list[dict[str, Any]]] = defaultdict(list)
    for record in records:
        settings = dotted(record.config["sampler"])
        place = tuple(collect.text_to_compare(settings.get(key)) for key in own)
        for m in _sizes(record):
            cells[place, m].append(settings)
    different: set[str] = set()
    for of_cell in cells.values():
        different |= _different(of_cell)
    return sorted(different.difference(own, NOT_IN_NAMES))


def _of_training(
    records: Sequence[RunRecord], apart: Sequence[str], are_of_one_net: bool
) -> list[str]:
    """Return the settings outside the sampler in which runs for one cell and seed differ.

    Args:
        records: of a row.
        apart: settings by which the runs are told apart already.
        are_of_one_net: whether the columns are not the nets.
    """
    cells: dict[Any, list[dict[str, Any]]] = defaultdict(list)
    for record in records:
        settings = considered(record) | dotted(record.config["sampler"], "sampler")
        place = tuple(collect.text_to_compare(settings.get(key)) for key in apart)
        net = None
        if not are_of_one_net:
            net = record.task_weights_sha256
        for m in _sizes(record):
            cell = (place, net, m, collect.seed(record))
            cells[cell].append(settings)
            if not record.evaluated:  # alone, too: a test does not know its run's rate
                cells["trained", *cell].append(settings)
    different: set[str] = set()
    for of_cell in cells.values():
        shared = set.intersection(*map(set, of_cell))  # Adam has no momentum
        different |= _different(of_cell) & shared
    return sorted(key for key in different if not key.startswith(SAMPLER))


def _different(several: Sequence[dict[str, Any]]) -> set[str]:
    """Return the keys whose values differ between settings."""
    keys: set[str] = set()
    for settings in several:
        keys.update(settings)
    different = set()
    for key in keys:
        values = {collect.text_to_compare(settings.get(key)) for settings in several}
        if len(values) > 1:
            different.add(key)
    return different


def _sizes(record: RunRecord) -> set[int]:
    """Return the sizes that a run tested its sampler at."""
    sizes = set()
    for key in record.metrics:
        name = parse_metric_name(key)
        if name is None or name.readout not in READOUTS:
            continue
        m = name.m
        if m is None:
            m = record.config["m"]
        sizes.add(m)
    return sizes


def _texts(record: RunRecord, keys: Sequence[str], classes: set[str]) -> list[str]:
    """Return arguments of a record's sampler as parts of a name.

    Args:
        record: of a run.
        keys: the arguments.
        classes: of all samplers of the row; one is shown by its last name where that differs.
    """
    settings = dotted(record.config["sampler"])
    last_names = {name.rpartition(".")[2] for name in classes}
    are_unique = len(last_names) == len(classes)
    texts = []
    for key in keys:
        value = _written(settings.get(key))
        if key != TARGET:
            texts.append(f"{key}={value}")
        elif are_unique:
            texts.append(value.rpartition(".")[2])
        else:
            texts.append(value)
    return texts


def _texts_of_training(record: RunRecord, keys: Sequence[str]) -> list[str]:
    """Return dotted settings of a record as parts of a name; a test lacks those of its run."""
    settings = considered(record)
    labels = _short(keys)
    texts = []
    for key in keys:
        if key not in settings:
            continue
        value = _written(settings[key])
        if key.rpartition(".")[2] == TARGET:
            texts.append(value.rpartition(".")[2])
        else:
            texts.append(f"{labels[key]}={value}")
    return texts


def _written(value: Any) -> str:
    """Return a setting as a user writes it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return str(collect.plain_number(value))


def _short(keys: Sequence[str]) -> dict[str, str]:
    """Return the last name of each dotted setting, or the whole one where two would be equal."""
    last_names = [key.rpartition(".")[2] for key in keys]
    labels = {}
    for key, last_name in zip(keys, last_names, strict=True):
        labels[key] = last_name
        if last_names.count(last_name) > 1:
            labels[key] = key
    return labels


def net_labels(found: Sequence[RunRecord]) -> list[str]:
    """Return a name for the task net of each record, other names for other weights."""
    digests: dict[str, set[str | None]] = defaultdict(set)
    for record in found:
        digests[_net_label(record)].add(record.task_weights_sha256)
    labels = []
    for record in found:
        label = _net_label(record)
        if len(digests[label]) > 1:
            digest = str(record.task_weights_sha256)
            label += f" {digest[:8]}"
        labels.append(label)
    return labels


def _net_label(record: RunRecord) -> str:
    name = collect.names(record)["net"]
    given = record.config.get("weights")
    if record.evaluated and given == "run":
        return f"{name} of the training"
    if given in (None, "auto", "run"):
        return name
    path = str(given).partition("@")[0]
    file = Path(path).name
    if file.startswith(name):
        return file
    return f"{name} ({file})"


def sort_key(row: str) -> tuple[bool, int, list[tuple[float, str]]]:
    """Return a key that sorts rows as the paper's tables do, rows of other nets last.

    Numbers in names are sorted by their values.
    """
    _, other_net, sampler = row.rpartition(" on ")  # such as "dgcnn on mops fast"
    name = sampler.split()[0]  # without its recipe
    place = len(ORDER)
    if name in ORDER:
        place = ORDER.index(name)
    parts = []
    for part in NUMBER.split(row):
        try:
            parts.append((float(part), ""))
        except ValueError:
            parts.append((-math.inf, part))
    return bool(other_net), place, parts
