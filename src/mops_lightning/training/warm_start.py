"""What a sampler's weights start from; see ``Recipe.warm_start``."""

from torch import nn

from mops_lightning.errors import UserError
from mops_lightning.nets.warm_start import copy_pointwise_layers, copy_tensors
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.job import Job
from mops_lightning.zoo import weights

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
        record.notes["warm_start"] = {"layers": copied}
        said = f"the first {copied} layers are copies of {job.cfg.names.net}'s"
    if job.trainer.is_global_zero:
        print(f"Warm start: {said}.")


def _from_file(given: str, sampler: nn.Module, record: RunRecord) -> str:
    try:
        content = weights.read(given)
    except UserError as error:
        raise UserError(f"recipe.warm_start: {error}") from None
    if content["config"].get("learn") == "task":
        raise UserError(
            f"recipe.warm_start: {given} holds a task net. Give the weights file of a sampler, or "
            "true for a start from the task net's first layers."
        )
    copied, total = copy_tensors(content["state"], sampler), len(sampler.state_dict())
    if not copied:
        raise UserError(
            f"recipe.warm_start: no tensor of {given} fits this sampler. Give the weights file of "
            "a sampler of the same kind."
        )
    record.notes["warm_start"] = {"sha256": content["sha256"], "tensors": len(copied)}
    return f"{len(copied)} of {total} tensors are copies of {given}"
