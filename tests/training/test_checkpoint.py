"""A run that is stopped between any two steps goes on to the weights of an unbroken one."""

import pytest
import torch

from mops_lightning.data.loader import Augmentation, CloudLoader
from mops_lightning.errors import Interrupted
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.samplers.mops import MOPSNet
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.callbacks import StopBetweenSteps
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.schedules import one_cycle
from tests.support.training import quiet_trainer, small_dataset

EPOCHS = 3


class StopAt(StopBetweenSteps):
    """Gets its signal in a given step, as if the user had pressed Ctrl-C there."""

    def __init__(self, checkpoint, epoch, step):
        super().__init__(checkpoint)
        self.at = (epoch, step)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if (trainer.current_epoch, batch_idx) == self.at:
            self.received = 2


def fit(callbacks, checkpoint=None):
    """Train jointly, so that dropout and BatchNorm of both nets take part."""
    torch.manual_seed(0)
    module = Experiment(
        Classification(PointNetVanilla(3), 3),
        MOPSNet(8, feature_channels=(8, 8), rho_channels=(16, 8)),
        learn="joint",
        make_optimizer=lambda parameters: torch.optim.Adam(parameters, lr=1e-2),
        make_schedule=one_cycle,
    )
    data = small_dataset()
    augment = Augmentation(rotate_up=True, jitter=0.01)
    trainer = quiet_trainer(EPOCHS, callbacks=callbacks)
    trainer.fit(
        module,
        CloudLoader(data.train, 6, shuffle=True, augment=augment, drop_last=True),
        CloudLoader(data.test, 6),
        ckpt_path=checkpoint,
    )
    return module.state_dict()


@pytest.fixture(scope="module")
def unbroken():
    return fit([])


@pytest.mark.parametrize(("epoch", "step"), [(0, 0), (0, 3), (1, 0), (1, 1), (1, 3), (2, 2)])
def test_stopped_run_resumes_to_same_weights(unbroken, tmp_path, epoch, step):
    path = tmp_path / "last.ckpt"
    with pytest.raises(Interrupted, match="ckpt_path"):
        fit([StopAt(path, epoch, step)])
    resumed = fit([], path)
    assert [name for name in unbroken if not torch.equal(unbroken[name], resumed[name])] == []
