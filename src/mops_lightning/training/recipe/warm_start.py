"""Starting a sampler with copies of the task net's layers, or of another sampler's tensors."""

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from mops_lightning.config.shortened import shortening
from mops_lightning.errors import UserError
from mops_lightning.nets.layers import PointMLP
from mops_lightning.zoo import names, weights

CLOUDS = 64
"""Clouds whose statistics BatchNorm takes where the task net has none."""

NAMED = 3
"""Most tensors that a sentence names."""

Block = tuple[nn.Linear, nn.BatchNorm1d | None]


def warm_start_sampler(
    source: bool | str, sampler: nn.Module, net: nn.Module, clouds: Tensor
) -> tuple[dict[str, Any], str]:
    """Copy layers or tensors to a sampler, as ``recipe.warm_start`` says.

    Args:
        source: true for the task net's first layers, or a sampler's weights file.
        sampler: the sampler.
        net: the task net.
        clouds: ``(B, N, 3)`` training clouds, for BatchNorm where the task net has none.

    Returns:
        The numbers for the record, and a sentence about them.

    Raises:
        UserError: ``source`` names a file that is not a sampler's, or no tensor fits.
    """
    if isinstance(source, str):
        return _from_file(source, sampler)
    copied = copy_pointwise_layers(net, sampler, clouds[:CLOUDS])
    text = "no layer is like one of the task net's"
    if copied:
        text = f"the first {copied} layers are copies of the task net's"
    return {"layers": copied}, text


def _from_file(name: str, sampler: nn.Module) -> tuple[dict[str, Any], str]:
    try:
        content = weights.read(weights.of_run(names.resolve(name)))
    except UserError as error:
        raise UserError(f"recipe.warm_start: {error}") from None
    if content["config"].get("learn") == "task":
        raise UserError(
            f"recipe.warm_start: {name} holds a task net. Give the weights file of a sampler, or "
            "true for a start from the task net's first layers."
        )
    if reasons := shortening(content["config"]):
        raise UserError(
            f"recipe.warm_start: {name} was trained with {' '.join(reasons)}. Give the weights "
            "file of a whole training."
        )
    copied = copy_tensors(content["state"], sampler)
    if not copied:
        raise UserError(
            f"recipe.warm_start: no tensor of {name} fits this sampler. Give the weights file of "
            "a sampler of the same kind."
        )
    numbers = {"sha256": content["sha256"], "tensors": len(copied)}
    tensors = list(sampler.state_dict())
    text = f"{len(copied)} of {len(tensors)} tensors are copies of {name}"
    # Between samplers with and without anchors, the last layer is not copied.
    left = [tensor for tensor in tensors if tensor not in copied]
    if left:
        text += f"; not copied: {', '.join(left[:NAMED])}"
    if len(left) > NAMED:
        text += ", ..."
    return numbers, text


@torch.no_grad()
def copy_pointwise_layers(source: nn.Module, target: nn.Module, points: Tensor) -> int:
    """Copy the first layers of one net's first ``PointMLP`` to another net's first ``PointMLP``.

    Layers are copied up to the first whose shapes differ, each with its BatchNorm and running
    statistics. Where only the target has BatchNorm, its statistics are computed from ``points``,
    and its scale and shift undo the normalization and add the source's bias, so that both layers
    compute the same in evaluation.

    Args:
        source: the net to copy from.
        target: the net to copy to.
        points: ``(B, N, 3)`` typical clouds.

    Returns:
        The number of linear layers copied; 0 if a net has no ``PointMLP``.
    """
    rows = points.flatten(0, 1)
    copied = 0
    for original, block in zip(_blocks(source), _blocks(target), strict=False):
        if not _fits(original, block):
            break
        rows = _copy_block(original, block, rows)
        copied += 1
    return copied


def _fits(source: Block, target: Block) -> bool:
    """Return whether a layer, and its BatchNorm if it has one, can be copied to another."""
    original, norm = source
    layer, own_norm = target
    has_place_for_norm = norm is None or own_norm is not None
    return original.weight.shape == layer.weight.shape and has_place_for_norm


def _copy_block(source: Block, target: Block, rows: Tensor) -> Tensor:
    """Copy a layer with its BatchNorm; return its output for ``rows``."""
    original, norm = source
    layer, own_norm = target
    layer.weight.copy_(original.weight)
    if layer.bias is not None and original.bias is not None:
        layer.bias.copy_(original.bias)
    output = layer(rows)
    if own_norm is None:
        return output.relu_()
    if norm is not None:
        own_norm.load_state_dict(norm.state_dict())
    else:
        _undo(own_norm, output, original.bias)
    normalized = nn.functional.batch_norm(
        output, own_norm.running_mean, own_norm.running_var, own_norm.weight, own_norm.bias
    )
    return normalized.relu_()


@torch.no_grad()
def copy_tensors(source: dict[str, Tensor], target: nn.Module) -> list[str]:
    """Copy tensors of one net to another net's tensors of the same name.

    Where only the number of rows differs, as between samplers of two sizes, the rows that both
    have are copied. Tensors that differ in more are left.

    Args:
        source: a ``state_dict``.
        target: the net to copy to.

    Returns:
        The names of the tensors that got values.
    """
    copied = []
    for name, tensor in target.state_dict().items():
        values = source.get(name)
        if values is None or values.ndim != tensor.ndim:
            continue
        if values.shape[1:] != tensor.shape[1:]:
            continue
        if tensor.ndim == 0:
            tensor.copy_(values)
        else:
            rows = min(len(tensor), len(values))
            tensor[:rows] = values[:rows].to(tensor.dtype)
        copied.append(name)
    return copied


def _blocks(net: nn.Module) -> list[Block]:
    """Return the linear layers of a net's first ``PointMLP``, each with its BatchNorm."""
    blocks: list[Block] = []
    for layer, following in pairwise([*_layers(net), None]):
        if not isinstance(layer, nn.Linear):
            continue
        if isinstance(following, nn.BatchNorm1d):
            blocks.append((layer, following))
        else:
            blocks.append((layer, None))
    return blocks


def _layers(net: nn.Module) -> list[nn.Module]:
    """Return the layers of a net's first ``PointMLP``; none if it has none."""
    for module in net.modules():
        if isinstance(module, PointMLP):
            return list(module.layers)
    return []


def _undo(norm: nn.BatchNorm1d, rows: Tensor, bias: Tensor | None) -> None:
    """Set BatchNorm so that it maps ``rows`` to themselves plus ``bias``."""
    variance, mean = torch.var_mean(rows, 0, correction=0)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    norm.running_mean.copy_(mean)
    norm.running_var.copy_(variance)
    norm.weight.copy_((variance + norm.eps).sqrt())
    norm.bias.copy_(mean)
    if bias is not None:
        norm.bias.add_(bias)
