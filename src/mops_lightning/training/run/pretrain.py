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
from mops_lightning.training.evaluation import OF_RUN
from mops_lightning.training.run.build import Parts, build_parts
from mops_lightning.training.run.callbacks import STANDARD
from mops_lightning.training.run.whole import recorded, train_and_test
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
        dataset: to train on.
        run_folder: where a shortened training leaves its net, which is not cached.

    Returns:
        None for ``weights=null`` (the net stays as initialised), for a resumed run (its checkpoint
        contains the task net), and for an evaluated run.
    """
    if cfg.weights in (None, OF_RUN) or cfg.ckpt_path is not None:
        return None
    if cfg.weights == "auto" and cfg.learn == "task":
        return cfg.pretrain_from and weights.of_task_net(cfg.pretrain_from)
    if cfg.weights != "auto":
        return weights.of_task_net(cfg.weights)
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
    if shortening(_plain(cfg)):
        folder = run_folder / SHORTENED
        _train(cfg, folder, dataset)
    else:
        with _lock(folder, cfg.names.net):
            if not (folder / FILE).is_file():  # otherwise another process trained it meanwhile
                _train(cfg, folder, dataset)
    return folder / FILE


def _train(cfg: DictConfig, folder: Path, dataset: CloudDataset) -> None:
    """Train the task net of a run in a folder, or resume its interrupted training there."""
    epochs = cfg.epochs.task
    print(
        f"No cached weights of {cfg.names.net} for {cfg.names.dataset}: training it "
        f"first, {epochs} {'epoch' if epochs == 1 else 'epochs'}. Cache: {folder}",
        flush=True,
    )
    own = task_config(cfg)
    if (folder / "checkpoints" / CHECKPOINT).is_file():
        own.ckpt_path = str(folder)
    try:
        with recorded(own, folder, []) as record:
            start = task_weights(own, dataset, folder)
            train_and_test(build_parts(own, folder, dataset, record), record, start)
    except (KeyboardInterrupt, Interrupted):
        raise Interrupted("The same command resumes the task net's training.") from None


def _plain(cfg: DictConfig) -> Any:
    return OmegaConf.to_container(cfg, resolve=True)


def task_config(cfg: DictConfig) -> DictConfig:
    """Return the configuration of the run that trains the task net of ``cfg`` alone."""
    own = cfg.copy()
    with open_dict(own):
        if cfg.learn != "task":
            if cfg.trainer.max_epochs == UNLIMITED:
                own.trainer.pop("max_steps", None)  # the length of the sampler's training
            own.trainer.max_epochs = cfg.epochs.task
            own.optimizer = cfg.pretrain
            own.weights = "auto"
            for name in set(cfg.callbacks) - set(STANDARD):  # such as early stopping on a score
                del own.callbacks[name]
        own.learn = "task"
        own.trainer.devices, own.trainer.strategy = 1, "auto"
        own.ckpt_path = None
        own.evaluate = None
    return own


def cache_folder(cfg: DictConfig, dataset: CloudDataset) -> Path:
    """Return the cache folder of the task net for these settings and data; it may not exist."""
    own = _plain(task_config(cfg))
    for name in SHORTENS:  # the cached net is that of a whole training
        own["trainer"].pop(name, None)
    key = checkpoint_identity(own, dataset.fingerprint)
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:12]
    name = f"{cfg.names.task}-{cfg.names.net}-{cfg.names.dataset}-{digest}"
    return Path(cfg.cache).expanduser() / "weights" / name


def add_to_cache(parts: Parts, record: RunRecord) -> None:
    """Copy a task net that was trained with ``learn=task`` into the cache, unless one is there.

    Not from a shortened run; not from one that was resumed with another number of epochs, whose
    learning rates differed; not from one that started from given weights; and not from several
    devices: the BatchNorm statistics of each cover its share of the data only.
    """
    cfg = parts.cfg
    if cfg.learn != "task" or not parts.trains or parts.trainer.world_size > 1:
        return
    if record.partial or shortening(record.config):
        return
    if cfg.weights not in (None, "auto"):
        return
    if parts.resumed is not None and parts.resumed.planned != cfg.trainer.max_epochs:
        return
    target = cache_folder(cfg, parts.dataset) / FILE
    if not target.is_file():
        remove_temporary(target.parent, below=False)
        with atomic_write(target) as temporary:
            shutil.copyfile(parts.folder / FILE, temporary)


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
