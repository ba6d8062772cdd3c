"""TensorBoard's logger: the names of curves and settings, and what it writes for a test."""

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mops_lightning.training.run.board import Board, board_settings, curve_name
from tests.support.records import record

CURVES = {
    "val/generated/accuracy": "curves/1 val accuracy, generated",
    "val/matched/accuracy": "curves/2 val accuracy, matched",
    "val/completed/accuracy": "curves/3 val accuracy, completed",
    "val/projected/accuracy": "curves/4 val accuracy, projected",
    "val/sampled/accuracy": "curves/5 val accuracy, sampled",
    "val/full/accuracy": "curves/6 val accuracy, full",
    "val/m32/matched/accuracy": "curves/2 val accuracy, matched, m32",
    "train/mean_loss": "curves/7 train loss",
    "train/tau": "curves/8 tau",
    "val/generated/mean_class_accuracy": "val/generated/mean_class_accuracy",
    "val/fps/accuracy": "val/fps/accuracy",
    "train/generated/accuracy": "train/generated/accuracy",
    "test/generated/accuracy": "test/generated/accuracy",
}


@pytest.mark.parametrize(("name", "curve"), CURVES.items())
def test_curve_name_puts_scores_of_held_out_clouds_first(name, curve):
    assert curve_name(name, "accuracy") == curve


def test_board_settings_are_names_sizes_and_what_the_user_changed():
    config = {
        "m": 16,
        "seed": 3,
        "learn": "joint",
        "batch_size": 8,
        "optimizer": {"lr": 0.002, "betas": [0.9, 0.99]},
        "trainer": {"max_epochs": 7},
        "sampler": {"alpha": 3.0, "tau_min": 0.1},
        "tags": ["first", "wide"],
    }
    overrides = ["sampler.alpha=3", "++optimizer.betas=[0.9,0.99]", "~logger", "+x.y=1"]

    shown = board_settings(record(config, overrides=overrides))

    assert shown == {
        "task": "classification",
        "net": "pointnet",
        "dataset": "shapes",
        "sampler": "mops",
        "m": 16,
        "seed": 3,
        "learn": "joint",
        "batch_size": 8,
        "optimizer.lr": 0.002,
        "trainer.max_epochs": 7,
        "sampler.alpha": 3.0,
        "optimizer.betas": "[0.9, 0.99]",
        "tags": "first, wide",
    }


def written(folder):
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    return accumulator


def test_board_writes_metrics_but_epochs_below_its_folders(tmp_path):
    board = Board(tmp_path, "accuracy", "name", "version", prefix="mine", sub_dir="below")

    board.log_metrics({"train/tau": 0.5, "epoch": 3.0}, step=7)
    board.save()

    events = written(tmp_path / "name" / "version" / "below")
    assert events.Tags()["scalars"] == ["mine-curves/8 tau"]
    (event,) = events.Scalars("mine-curves/8 tau")
    assert (event.step, event.value) == (7, 0.5)


def test_board_writes_a_test_as_a_sorted_table_at_the_step_of_the_training(tmp_path):
    metrics = {"test/matched/accuracy": 0.123456789, "test/generated/accuracy": 0.5}
    board = Board(tmp_path)

    board.log_test(record(metrics=metrics), {"test/generated/accuracy": 0.5}, step=9)
    board.save()

    (event,) = written(tmp_path).Tensors("test/text_summary")
    assert event.step == 9
    assert event.tensor_proto.string_val[0].decode().splitlines() == [
        "| metric | value |",
        "|---|--:|",
        "| test/generated/accuracy | 0.5 |",
        "| test/matched/accuracy | 0.123457 |",
    ]


def test_board_writes_clouds_with_their_samples_at_the_step_of_the_training(tmp_path):
    rng = torch.Generator().manual_seed(0)
    cloud = torch.rand(1, 20, 3, generator=rng)
    samples = {"generated": cloud[:, :4], "matched": cloud[:, 4:8]}
    board = Board(tmp_path)

    board.add_clouds(cloud, samples, step=5)
    board.save()

    events = written(tmp_path)
    colours = {}
    for name in samples:
        (vertices,) = events.Tensors(f"clouds/{name}_VERTEX")
        (colour,) = events.Tensors(f"clouds/{name}_COLOR")
        assert vertices.step == 5
        assert [size.size for size in vertices.tensor_proto.tensor_shape.dim] == [1, 24, 3]
        colours[name] = colour.tensor_proto
    assert colours["generated"] != colours["matched"]
