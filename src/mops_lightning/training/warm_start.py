"""What a sampler's weights start from; see ``Recipe.warm_start``."""

from collections.abc import Sequence

from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.nets.warm_start import copy_pointwise_layers, copy_tensors
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.job import Job
from mops_lightning.zoo import names, weights

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
