"""Comparing methods of downsampling by a task net, on the command line and in Python."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.files.arguments import check_out
from mops_lightning.files.task_net import keep, tables
from mops_lightning.files.task_net.clouds import HALVES, read_sources
from mops_lightning.files.task_net.held_out import files_of, without_training_files
from mops_lightning.files.task_net.measure import check_sizes, score_methods, score_of
from mops_lightning.files.task_net.methods import Method, Trained, methods_of
from mops_lightning.files.task_net.subject import (
    Loss,
    Subject,
    check_numbers,
    subject_of_module,
    subject_of_run,
)
from mops_lightning.files.task_net.tables import Comparison
from mops_lightning.samplers.base import Sampler

DRAWS = 5


def compare_task_net(
    files: str | Path | Sequence[str | Path],
    task_net: str | Path | nn.Module,
    m: Sequence[int],
    *,
    loss: Loss | None = None,
    weights: str | Path | Sampler | Sequence[str | Path | Sampler] = (),
    methods: Sequence[str] | None = None,
    draws: int = DRAWS,
    crops: int | None = None,
    points: int | None = None,
    label: str | None = None,
    columns: Sequence[str] | None = None,
    seed: int = 0,
    save: str | Path | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
) -> Comparison:
    """Score a task net from the points that methods of downsampling choose from files.

    Every draw cuts clouds from all files, as the net was trained. All methods of a draw see the
    same clouds.

    Args:
        files: files, or folders of them. Classification takes the class of a file from the nearest
            folder above it that has a class's name.
        task_net: a run, a model, a weights file, or a trained module that maps points ``(B, M, 3)``
            to an output.
        m: numbers of points.
        loss: of a module, a function of its output and a ``Batch``: one number, or one per cloud.
            The position of a file's folder among all folders is in ``batch.labels``, and the column
            ``label`` in ``batch.parts``.
        weights: trained samplers, each a run, a model, a weights file or a ``Sampler``; by default
            the one that the run of the task net trained. ``save`` leaves out a ``Sampler``.
        methods: names of methods without training; None: all that the net allows. Farthest points
            are always among them.
        draws: number of draws.
        crops: number of clouds of every file and draw; None: 8 crops, or 1 whole cloud.
        points: number of points of a cloud; None: as in training.
        label: column with the parts of points, for segmentation; None: as in training.
        columns: names of the columns of .bin files; None: those that their names imply.
        seed: of all draws.
        save: file for the best method of every number of points, which ``load`` and
            ``downsample`` take; None: it is not kept.
        out: folder for the table, the curve and the page; None: they are not written.
        overwrite: replace ``save`` and an earlier comparison in ``out``.

    Returns:
        All scores as a table (``frame``), and the ``sentence`` that says which method to use.

    Raises:
        UserError: an argument or a file is invalid.
    """
    check_numbers(points, crops, draws)
    kept = None
    if save is not None:
        kept = _free(keep.file_of(str(save)), overwrite)
    if out is not None:
        check_out(Path(out), overwrite, tables.FILES)
    subject = _subject(task_net, loss, points, crops, label)
    sizes = sorted(set(m))
    check_sizes(sizes, subject.n_points, subject)
    compared = methods_of(methods, _samplers(weights), subject, sizes)
    paths = files_of([Path(path) for path in _paths(files)])
    paths = without_training_files(paths, _configs(subject, compared))
    if kept is not None and len(paths) < 2:
        raise UserError(
            "--save checks its choice on files that it was not made on: give two files or more, "
            f"got {len(paths)}."
        )
    sources = read_sources(paths, subject, seed, columns)
    halves = {source.half for source in sources}
    if kept is not None and halves != set(HALVES):
        raise UserError("--save needs two files or more of one class.")
    scores = score_methods(sources, subject, compared, sizes, draws, seed)
    frame = pd.DataFrame([asdict(score) for score in scores])
    metric = score_of(subject)
    choices: list[keep.Choice] = []
    if kept is not None:
        choices = keep.choose(frame, metric, compared)
        keep.save(kept, choices, compared, seed)
    own = [method.name for method in compared if isinstance(method, Trained)]
    comparison = Comparison(frame, metric, subject.name, len(sources), own, choices, kept)
    if out is not None:
        comparison.write(Path(out))
    return comparison


def _paths(files: str | Path | Sequence[str | Path]) -> list[str | Path]:
    if isinstance(files, str | Path):
        return [files]
    return list(files)


def _samplers(
    weights: str | Path | Sampler | Sequence[str | Path | Sampler],
) -> list[str | Sampler]:
    """Return one sampler or several as a list, paths as texts."""
    if isinstance(weights, str | Path | Sampler):
        weights = [weights]
    samplers: list[str | Sampler] = []
    for given in weights:
        if isinstance(given, Sampler):
            samplers.append(given)
        else:
            samplers.append(str(given))
    return samplers


def _free(path: Path, overwrite: bool) -> Path:
    """Return a path that may be written.

    Raises:
        UserError: there is a file, which is not to be replaced.
    """
    if path.exists() and not overwrite:
        raise UserError(f"--save: {path} exists. Give another name, or --overwrite.")
    return path


def _subject(
    task_net: str | Path | nn.Module,
    loss: Loss | None,
    points: int | None,
    crops: int | None,
    label: str | None,
) -> Subject:
    if isinstance(task_net, str | Path):
        if loss is not None:
            raise UserError("loss is for a module of your own: a run has its task's loss.")
        return subject_of_run(str(task_net), points, crops, label)
    return subject_of_module(task_net, loss, points, crops, label)


def _configs(subject: Subject, methods: Sequence[Method]) -> list[dict[str, Any]]:
    """Return the settings of the runs that trained the net and the samplers."""
    trained = [method for method in methods if isinstance(method, Trained)]
    return [subject.config, *(method.config() for method in trained)]
