"""The task net's weights: given, found in the cache, or trained first."""

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from filelock import AcquireReturnProxy, FileLock, Timeout
from omegaconf import DictConfig, OmegaConf, open_dict

from mops_lightning.config import distributed
from mops_lightning.config.shortened import SHORTENS, UNLIMITED, shortening
from mops_lightning.data.clouds import CloudDataset
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.filesystem import atomic_write, remove_temporary
from mops_lightning.records.run_record import RunRecord
from mops_lightning.training.checkpoint import CHECKPOINT, checkpoint_identity
from mops_lightning.training.evaluation import OF_RUN, names_a_net
from mops_lightning.training.run.build import build_parts
from mops_lightning.training.run.callbacks import DEFAULT_CALLBACKS
from mops_lightning.training.run.parts import Parts
from mops_lightning.training.run.recorded import recorded
from mops_lightning.training.run.stages import train_and_test
from mops_lightning.zoo import weights
from mops_lightning.zoo.weights import FILE

SHORTENED = "task_net"
"""Folder below the run's for a task net from a shortened training."""


def task_weights(cfg: DictConfig, dataset: CloudDataset, run_folder: Path) -> Path | None:
    """Return the file that ``weights`` names; ``auto`` trains the net when it is not cached.

    With ``learn=task``, training starts from the given file; with ``auto`` from
    ``pretrain_from``, if it is set.

    Args:
        cfg: the run's settings.
        dataset: the data to train on.
        run_folder: where a shortened training leaves its net, which is not cached.

    Returns:
        None for ``weights=null`` (the net stays as initialised), for a resumed run (its checkpoint
        contains the task net), and for an evaluated run.
    """
    if cfg.weights in (None, OF_RUN) or cfg.ckpt_path is not None:
        return None
    if names_a_net(cfg.weights):
        return weights.of_task_net(cfg.weights)
    if cfg.learn == "task":
        return _start_weights(cfg.pretrain_from)
    folder = cache_folder(cfg, dataset)
    remove_temporary(folder)
    if (folder / FILE).is_file():
        return folder / FILE
    if distributed.started_together(cfg):
        raise UserError(
            f"weights: {cfg.names.net} must be trained before a launcher starts several "
            "processes. Run the same command once with learn=task trainer=auto and without "
            "the launcher, or give weights=FILE."
        )
    shortened = shortening(_plain(cfg))
    if shortened:
        folder = run_folder / SHORTENED
        _train(cfg, folder, dataset, shortened)
    else:
        with _lock(folder, cfg.names.net):
            if not (folder / FILE).is_file():  # otherwise another process trained it meanwhile
                _train(cfg, folder, dataset, shortened)
    return folder / FILE


def _train(cfg: DictConfig, folder: Path, dataset: CloudDataset, shortened: list[str]) -> None:
    """Train the task net of a run in a folder, or resume its interrupted training there."""
    epochs = f"{cfg.epochs.task} epochs"
    if cfg.epochs.task == 1:
        epochs = "1 epoch"
    if shortened:
        epochs += f", shortened by {', '.join(shortened)}"
    print(
        f"No cached weights of {cfg.names.net} for {cfg.names.dataset}: training it "
        f"first, {epochs}. Cache: {folder}",
        flush=True,
    )
    task_cfg = task_config(cfg)
    is_resumed = (folder / "checkpoints" / CHECKPOINT).is_file()
    if is_resumed:
        task_cfg.ckpt_path = str(folder)
    try:
        with recorded(_plain(task_cfg), folder, []) as record:
            start = None
            if not is_resumed:
                start = _start_weights(cfg.pretrain_from)
            parts = build_parts(task_cfg, folder, dataset, record)
            train_and_test(parts, record, start)
    except (KeyboardInterrupt, Interrupted):
        raise Interrupted("The same command resumes the task net's training.") from None


def _start_weights(pretrain_from: str | None) -> Path | None:
    """Return the file that the training of a task net starts from; None: as initialised."""
    if pretrain_from is None:
        return None
    return weights.of_task_net(pretrain_from)


def _plain(cfg: DictConfig) -> Any:
    return OmegaConf.to_container(cfg, resolve=True)


def task_config(cfg: DictConfig) -> DictConfig:
    """Return the configuration of the run that trains the task net of ``cfg`` alone."""
    task_cfg = cfg.copy()
    with open_dict(task_cfg):
        if cfg.learn != "task":
            _take_pretraining(task_cfg, cfg)
        task_cfg.learn = "task"
        task_cfg.trainer.devices = 1
        task_cfg.trainer.strategy = "auto"
        task_cfg.ckpt_path = None
        task_cfg.evaluate = None
    return task_cfg


def _take_pretraining(task_cfg: DictConfig, cfg: DictConfig) -> None:
    """Replace the settings of a sampler's training by those of the training before it."""
    if cfg.trainer.max_epochs == UNLIMITED:
        task_cfg.trainer.pop("max_steps", None)  # the length of the sampler's training
    task_cfg.trainer.max_epochs = cfg.epochs.task
    task_cfg.optimizer = cfg.pretrain
    task_cfg.weights = "auto"
    for name in cfg.callbacks:
        if name not in DEFAULT_CALLBACKS:  # such as early stopping on a score
            del task_cfg.callbacks[name]


def cache_folder(cfg: DictConfig, dataset: CloudDataset) -> Path:
    """Return the cache folder of the task net for these settings and data; it may not exist."""
    settings = _plain(task_config(cfg))
    for name in SHORTENS:  # the cached net is that of a whole training
        settings["trainer"].pop(name, None)
    key = checkpoint_identity(settings, dataset.fingerprint)
    text = json.dumps(key, sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()
    names = cfg.names
    name = f"{names.task}-{names.net}-{names.dataset}-{digest[:12]}"
    return Path(cfg.cache).expanduser() / "weights" / name


def add_to_cache(parts: Parts, record: RunRecord) -> None:
    """Copy a task net that was trained with ``learn=task`` into the cache, unless one is there.

    Not from a shortened run; not from one that was resumed with another number of epochs, whose
    learning rates differed; not from one that started from given weights; and not from several
    devices: the BatchNorm statistics of each cover its share of the data only.
    """
    if not _is_for_cache(parts, record):
        return
    target = cache_folder(parts.cfg, parts.dataset) / FILE
    if not target.is_file():
        remove_temporary(target.parent, below=False)
        with atomic_write(target) as temporary:
            shutil.copyfile(parts.folder / FILE, temporary)


def _is_for_cache(parts: Parts, record: RunRecord) -> bool:
    """Return whether a run trained a task net as ``weights=auto`` would; see ``add_to_cache``."""
    cfg = parts.cfg
    if cfg.learn != "task" or not parts.trains or parts.trainer.world_size > 1:
        return False
    if record.partial or shortening(record.config):
        return False
    if cfg.weights not in (None, "auto"):
        return False
    return parts.resumed is None or parts.resumed.planned == cfg.trainer.max_epochs


def _lock(folder: Path, net: str) -> AcquireReturnProxy:
    """Lock a cache folder, so that one process at a time trains the net in it.

    The lock is a file next to the folder. A process that is killed releases it.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.parent / f"{folder.name}.lock"
    lock = FileLock(path)
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        print(f"Waiting for another process that trains {net} ({path})", flush=True)
        return lock.acquire(poll_interval=0.5)
