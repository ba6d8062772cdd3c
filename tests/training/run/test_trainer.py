from pathlib import Path

import pytest
from lightning.pytorch.callbacks.progress.progress_bar import get_standard_metrics
from lightning.pytorch.profilers import AdvancedProfiler, PyTorchProfiler, SimpleProfiler

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.nets.pointnet import PointNetVanilla
from mops_lightning.tasks.classification import Classification
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.recipe.moving_average import MovingAverage
from mops_lightning.training.recipe.recipe import Recipe
from mops_lightning.training.run.checkpoint_io import AtomicCheckpointIO
from mops_lightning.training.run.ending import StopBetweenSteps, StopWithCheckpoint
from mops_lightning.training.run.make_experiment import make_experiment
from mops_lightning.training.run.trainer import make_trainer, shown_score
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


def trainer_of(folder, *overrides, clouds=8, recipe=None):
    experiment = Experiment(Classification(PointNetVanilla(3), 3), learn="task", recipe=recipe)
    cfg = compose([*TINY, *overrides])
    return make_trainer(cfg, folder, small_dataset(), experiment, clouds)


def test_make_trainer_works_in_the_folder_and_checks_nothing_first(tmp_path):
    trainer = trainer_of(tmp_path)

    assert trainer.default_root_dir == str(tmp_path)
    assert trainer.num_sanity_val_steps == 0
    kinds = {type(callback).__name__ for callback in trainer.callbacks}
    assert "ModelSummary" not in kinds


@pytest.mark.parametrize(
    ("settings", "clouds", "steps"),
    [
        ([], 3, 1),
        ([], 8, 2),
        ([], 43, 10),
        ([], 400, 10),
        (["+trainer.log_every_n_steps=7"], 400, 7),
        (["+trainer.barebones=true"], 400, 0),
    ],
)
def test_make_trainer_logs_every_ten_steps_or_once_in_an_epoch(settings, clouds, steps, tmp_path):
    trainer = trainer_of(tmp_path, "batch_size=4", *settings, clouds=clouds)

    assert trainer.log_every_n_steps == steps


def test_make_trainer_puts_the_moving_average_before_the_callbacks_that_save_it(tmp_path):
    trainer = trainer_of(tmp_path, recipe=Recipe(ema_span=0.5))

    kinds = [type(callback).__name__ for callback in trainer.callbacks]
    assert kinds.index(MovingAverage.__name__) < kinds.index("EpochLines")
    assert kinds.index(MovingAverage.__name__) < kinds.index("ModelCheckpoint")


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("simple", SimpleProfiler),
        ("advanced", AdvancedProfiler),
        ("pytorch", PyTorchProfiler),
    ],
)
def test_make_trainer_profilers_write_into_the_folder(name, kind, tmp_path):
    trainer = trainer_of(tmp_path, f"+trainer.profiler={name}")

    profiler = trainer.profiler
    assert type(profiler) is kind
    assert profiler.dirpath == tmp_path
    assert profiler.filename == "profile"


def test_make_trainer_takes_a_profiler_of_the_users(tmp_path):
    target = "lightning.pytorch.profilers.SimpleProfiler"

    trainer = trainer_of(tmp_path, f"+trainer.profiler={{_target_: {target}, filename: mine}}")

    assert type(trainer.profiler) is SimpleProfiler
    assert trainer.profiler.filename == "mine"


def test_make_trainer_refuses_half_precision_without_a_gpu(tmp_path):
    said = r"16-mixed needs a GPU, .* Try trainer\.precision=bf16-mixed"

    with pytest.raises(UserError, match=said):
        trainer_of(tmp_path, "trainer.precision=16-mixed")


def test_synchronised_batchnorm_of_several_cpus_is_refused(tmp_path):
    several = ["trainer=ddp", "trainer.accelerator=cpu", "trainer.devices=2"]
    with pytest.raises(UserError, match=r"sync_batchnorm=true needs GPUs, and none was found"):
        trainer_of(tmp_path, *several, "+trainer.sync_batchnorm=true")


@pytest.mark.parametrize(
    ("settings", "has_path"),
    [
        ([], True),
        (["+trainer.fast_dev_run=true"], False),
        (["+trainer.enable_checkpointing=false"], False),
        (["+trainer.barebones=true"], False),
    ],
)
def test_make_trainer_stops_with_a_checkpoint_where_the_run_writes_any(
    settings, has_path, tmp_path
):
    trainer = trainer_of(tmp_path, *settings)

    (stop,) = [callback for callback in trainer.callbacks if isinstance(callback, StopBetweenSteps)]
    path = None
    if has_path:
        path = tmp_path / "checkpoints" / "last.ckpt"
    assert stop.checkpoint == path
    assert isinstance(stop, StopWithCheckpoint) == has_path


@pytest.mark.parametrize(
    ("task", "learn", "score"),
    [
        ("reconstruction", "task", "chamfer"),
        ("reconstruction", "sampler", "nre_cd"),
        ("classification", "task", "accuracy"),
    ],
)
def test_shown_score_of_a_task_net_alone_is_that_of_full_clouds(task, learn, score):
    made = make_experiment(compose([f"task={task}", f"learn={learn}", "m=8"]), small_dataset(), {})

    assert shown_score(made) == score
