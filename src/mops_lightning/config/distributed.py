"""One run on several processes (Lightning's DDP).

Rank 0 writes files and prints. Worker ranks only load, train and score.
"""

import os
from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from mops_lightning.config.overrides import key
from mops_lightning.errors import UserError

RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK", "GROUP_RANK", "SLURM_PROCID")
"""Environment variables with a process's rank: Lightning's own, torchrun's and SLURM's."""


def is_distributed(cfg: DictConfig) -> bool:
    """Return whether the settings request more than one device, on one node or on several."""
    nodes = cfg.trainer.get("num_nodes")
    if nodes not in (None, 1):
        return True
    devices = cfg.trainer.get("devices")
    if OmegaConf.is_list(devices):
        return len(devices) != 1
    return bool(devices != 1)


def is_worker_rank(cfg: DictConfig) -> bool:
    """Return whether this process is one of several and not the first of them."""
    return is_distributed(cfg) and any(_number(name) for name in RANKS)


def check_start(cfg: DictConfig, hydra_overrides: Sequence[str]) -> None:
    """Check a run whose processes were started by a launcher such as torchrun.

    Args:
        cfg: the run's settings.
        hydra_overrides: overrides of Hydra's own settings.

    Raises:
        UserError: the settings request one process, or every process would have its own folder.
    """
    number = _number("WORLD_SIZE")
    if number > 1 and not is_distributed(cfg):
        raise UserError(
            f"{number} processes were started (WORLD_SIZE), but trainer.devices=1. Give "
            "trainer=ddp trainer.devices=N, as many as on this host, or start one process."
        )
    if started_together(cfg) and "hydra.run.dir" not in map(key, hydra_overrides):
        raise UserError(
            "hydra.run.dir: processes that were started together need one folder. Give "
            "hydra.run.dir=FOLDER, which all of them see."
        )


def started_together(cfg: DictConfig) -> bool:
    """Return whether a launcher such as torchrun started all processes, not this program."""
    return is_distributed(cfg) and _number("WORLD_SIZE") + _number("SLURM_NTASKS") > 1


def check_multirun(cfg: DictConfig) -> None:
    """Reject a sweep whose runs request several devices each.

    Raises:
        UserError: they do; the processes of one run would repeat the whole sweep.
    """
    if is_distributed(cfg):
        raise UserError(
            "trainer.devices must be 1 in a sweep (-m). For runs side by side give "
            "hydra/launcher=joblib (or submitit_slurm), or start each large run without -m."
        )


def check_shares(batch_size: int, test_clouds: int, held_out: int, processes: int) -> None:
    """Reject sizes that cannot be split across processes.

    Args:
        batch_size: clouds in a batch of all processes together; each needs two for BatchNorm.
        test_clouds: number of test clouds.
        held_out: number of training clouds that are held out for ``val/``.
        processes: number of processes.

    Raises:
        UserError: a process would have no clouds, too few, or fewer than another one.
    """
    splits = {"test": test_clouds}
    if held_out:
        splits["held-out"] = held_out
    for name, clouds in splits.items():
        if clouds < processes:
            raise UserError(
                f"trainer.devices: {processes} devices are too many for {clouds} {name} clouds. "
                f"Try trainer.devices={clouds}."
            )
    is_divisible = batch_size % processes == 0 and batch_size >= 2 * processes
    if processes > 1 and not is_divisible:
        near = max(round(batch_size / processes), 2) * processes
        raise UserError(
            f"batch_size={batch_size} is the batch of all {processes} devices together: it must "
            f"be a multiple of {processes} and at least {2 * processes}. Try batch_size={near}."
        )


def _number(name: str) -> int:
    value = os.environ.get(name, "")
    if not value.isdigit():
        return 0
    return int(value)
