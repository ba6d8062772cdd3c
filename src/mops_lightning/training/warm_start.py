"""Starting a sampler with copies of other weights; see ``Recipe.warm_start``."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from mops_lightning.errors import UserError
from mops_lightning.nets.layers import PointMLP
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.job import Job
from mops_lightning.zoo import names, weights

Block = tuple[nn.Linear, nn.BatchNorm1d | None]

CLOUDS = 64
"""Clouds whose statistics BatchNorm takes where the task net has none."""


def warm_start(job: Job, record: RunRecord) -> None:
    """Copy layers to the sampler, unless the run is resumed; print and note which.

    Raises:
        UserError: ``recipe.warm_start`` names a file that is no sampler's or that fits nowhere.
    """
    experiment, given = job.experiment, job.experiment.recipe.warm_start
    if not given or experiment.sampler is None or job.resumed is not None:
        return
    if isinstance(given, str):
        said = _from_file(given, experiment.sampler, record)
    else:
        typical = job.dataset.train.points[:CLOUDS]
        copied = copy_pointwise_layers(experiment.task.net, experiment.sampler, typical)
        record.warm_start = {"layers": copied}
        said = f"the first {copied} layers are copies of {job.cfg.names.net}'s"
    if job.trainer.is_global_zero:
        print(f"Warm start: {said}.")


def _from_file(given: str, sampler: nn.Module, record: RunRecord) -> str:
    try:
        path = names.resolve(given)
        content = weights.read(weights.of_run(path) if path.is_dir() else path)
    except UserError as error:
        raise UserError(f"recipe.warm_start: {error}") from None
    if content["config"].get("learn") == "task":
        raise UserError(
            f"recipe.warm_start: {given} holds a task net. Give the weights file of a sampler, or "
            "true for a start from the task net's first layers."
        )
    copied = copy_tensors(content["state"], sampler)
    if not copied:
        raise UserError(
            f"recipe.warm_start: no tensor of {given} fits this sampler. Give the weights file of "
            "a sampler of the same kind."
        )
    record.warm_start = {"sha256": content["sha256"], "tensors": len(copied)}
    return described(copied, list(sampler.state_dict()), given)


def described(copied: Sequence[str], tensors: Sequence[str], given: str) -> str:
    """Return how many of a sampler's tensors are copies, and which are not.

    Between samplers with and without anchors, the last layer is not.

    Args:
        copied: names of the copies.
        tensors: all names.
        given: the file that the copies are from.
    """
    said = f"{len(copied)} of {len(tensors)} tensors are copies of {given}"
    new = [name for name in tensors if name not in copied]
    return f"{said}; not copied: {', '.join(new[:3])}{', ...' if new[3:] else ''}" if new else said


@torch.no_grad()
def copy_pointwise_layers(source: nn.Module, target: nn.Module, points: Tensor) -> int:
    """Copy the first layers of one net's first ``PointMLP`` to that of another.

    Layers are copied up to the first whose shapes differ, each with its BatchNorm and running
    statistics. Where only the target has BatchNorm, its statistics are those of ``points``, and
    its scale and shift undo the normalization and add the source's bias, so that both layers
    compute the same in evaluation.

    Args:
        source: the net to copy from.
        target: the net to copy to.
        points: ``(B, N, 3)`` typical clouds.

    Returns:
        The number of linear layers copied; 0 if a net has no ``PointMLP``.
    """
    rows, copied = points.flatten(0, 1), 0
    for (theirs, norm), (mine, own_norm) in zip(_blocks(source), _blocks(target), strict=False):
        same = theirs.weight.shape == mine.weight.shape
        if not same or (norm is not None and own_norm is None):
            break
        mine.weight.copy_(theirs.weight)
        if mine.bias is not None and theirs.bias is not None:
            mine.bias.copy_(theirs.bias)
        if own_norm is not None:
            if norm is not None:
                own_norm.load_state_dict(norm.state_dict())
            else:
                _undo(own_norm, mine(rows), theirs.bias)
        rows = mine(rows)
        if own_norm is not None:
            rows = nn.functional.batch_norm(
                rows, own_norm.running_mean, own_norm.running_var, own_norm.weight, own_norm.bias
            )
        rows = rows.relu_()
        copied += 1
    return copied


@torch.no_grad()
def copy_tensors(source: dict[str, Tensor], target: nn.Module) -> list[str]:
    """Copy tensors of one net to those of another that have the same name.

    Where only the number of rows differs, as between samplers of two sizes, the rows that both
    have are copied. Tensors that differ in more are left.

    Args:
        source: a ``state_dict``.
        target: the net to copy to.

    Returns:
        The names of the tensors that got values.
    """
    copied = []
    for name, mine in target.state_dict().items():
        theirs = source.get(name)
        if theirs is None or theirs.shape[1:] != mine.shape[1:] or theirs.ndim != mine.ndim:
            continue
        if mine.ndim == 0:
            mine.copy_(theirs)
        else:
            rows = min(len(mine), len(theirs))
            mine[:rows] = theirs[:rows].to(mine.dtype)
        copied.append(name)
    return copied


def _blocks(net: nn.Module) -> list[Block]:
    """Return the linear layers of a net's first ``PointMLP``, each with its BatchNorm."""
    stack = next((m.layers for m in net.modules() if isinstance(m, PointMLP)), nn.Sequential())
    blocks: list[Block] = []
    for layer, following in pairwise([*stack, None]):
        if isinstance(layer, nn.Linear):
            norm = following if isinstance(following, nn.BatchNorm1d) else None
            blocks.append((layer, norm))
    return blocks


def _undo(norm: nn.BatchNorm1d, rows: Tensor, bias: Tensor | None) -> None:
    """Set BatchNorm so that it maps ``rows`` to themselves plus ``bias``."""
    variance, mean = torch.var_mean(rows, 0, correction=0)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    norm.running_mean.copy_(mean)
    norm.running_var.copy_(variance)
    norm.weight.copy_((variance + norm.eps).sqrt())
    norm.bias.copy_(mean if bias is None else mean + bias)
