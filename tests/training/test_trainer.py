from mops_lightning.config.compose import compose
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.trainer import make_trainer
from tests.support.command_line import TINY
from tests.support.training import small_dataset


def test_make_trainer_writes_checkpoints_atomically(tmp_path):
    experiment = Experiment(Classification(PointNetVanilla(3), 3), learn="task")
    trainer = make_trainer(compose(TINY), tmp_path, small_dataset(), experiment)
    assert isinstance(trainer.strategy.checkpoint_io, AtomicCheckpointIO)
