from pathlib import Path

from lightning.pytorch.callbacks.progress.progress_bar import get_standard_metrics

from mops_lightning.config.compose import compose
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.trainer import make_trainer
from tests.support.command_line import TINY
from tests.support.training import small_dataset


def test_make_trainer_writes_checkpoints_atomically_and_shows_no_version(tmp_path):
    experiment = Experiment(Classification(PointNetVanilla(3), 3), learn="task")
    settings = [setting for setting in TINY if setting != "logger=none"]
    cfg = compose([*settings, "logger=tensorboard"])

    trainer = make_trainer(cfg, tmp_path, small_dataset(), experiment, clouds=8)

    assert isinstance(trainer.strategy.checkpoint_io, AtomicCheckpointIO)
    assert trainer.logger is not None
    assert trainer.logger.log_dir is not None
    assert Path(trainer.logger.log_dir) == tmp_path
    assert "v_num" not in get_standard_metrics(trainer)
