"""``compare_task_net`` as a user calls it in Python."""

from typing import Any

import numpy as np
import pytest
from torch import nn

from mops_lightning import FMOPSNet, FPSSampler, load
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.files.task_net.compare import compare_task_net
from mops_lightning.zoo import weights


class Extent(nn.Module):
    """Returns the largest coordinates: a net to which farthest points matter."""

    def forward(self, points):
        return points.amax(1)


def distance(output, batch):
    missing = output - batch.points.amax(1)
    return missing.norm(dim=1)


SMALL: dict[str, Any] = {"points": 64, "crops": 2, "draws": 3, "methods": ["random"]}


def test_scores_of_a_module_are_the_mean_losses_of_the_chosen_points(scans):
    chosen = []

    def remembered(output, batch):
        loss = distance(output, batch)
        chosen.append((batch.points, output, loss))
        return loss

    result = compare_task_net(scans, Extent(), [8], loss=remembered, **SMALL)

    whole = result.frame[result.frame.files == "all"]
    assert set(whole.method) == {"all points", "fps", "fps_farthest", "random"}
    assert whole[whole.method == "fps"].score.nunique() == 3  # every draw has other clouds
    first_draw = whole[whole.draw == 0]
    farthest = first_draw[first_draw.method == "fps_farthest"].score.item()
    # Two halves of three files in every draw; in each, all points come first.
    clouds = [points for points, _, loss in chosen if not loss.any()]
    expected = []
    for points in clouds[:2]:
        few = FPSSampler(8, start="farthest")(points).points
        missing = few.amax(1) - points.amax(1)
        expected += missing.norm(dim=1).tolist()
    assert len(expected) == 12
    assert farthest == pytest.approx(np.mean(expected), rel=1e-6)
    assert result.sentence.startswith("Use FPS")
    assert result.saved is None


def test_methods_with_the_same_mean_are_all_bold(scans):
    def constant(output, batch):
        return output.sum() * 0 + 2.0

    result = compare_task_net(scans, Extent(), [8], loss=constant, **SMALL)

    lines = result.text.splitlines()
    _, *rows = [line for line in lines if line.startswith("| ")]
    assert rows == [
        "| fps | **2.000** ± 0.000 |",
        "| random | **2.000** ± 0.000 |",
        "| fps_farthest | **2.000** ± 0.000 |",
        "| all points | 2.000 ± 0.000 |",
    ]


def test_samplers_in_memory_are_compared_and_not_saved(scans, tmp_path):
    samplers = [FMOPSNet(16), FMOPSNet(8)]
    best = tmp_path / "best"
    settings: dict[str, Any] = {"loss": distance, "weights": samplers, "save": best}

    result = compare_task_net(scans, Extent(), [8, 16], **settings, **SMALL)

    frame = result.frame
    of_second = frame[frame.method == "FMOPSNet_2"]
    assert result.own == ["FMOPSNet_1", "FMOPSNet_2"]
    assert of_second.m.unique().tolist() == [8]
    saved = load(best)
    assert not any(parameter.requires_grad for parameter in saved.parameters())
    chosen = {choice.method for choice in result.choices}
    assert chosen <= {"fps", "fps_farthest", "random"}


def test_sampler_that_sees_other_channels_is_refused(scans, tmp_path):
    channels = PointChannels([Channel("intensity", 100.0, 50.0)])
    node = {"_target_": "mops_lightning.samplers.fmops.FMOPSNet", "m_max": 16}
    path = tmp_path / "a.safetensors"
    config = {"learn": "sampler", "sampler": node}
    sampler = FMOPSNet(16, point_channels=channels)
    weights.save(path, sampler, config, {}, channels=channels)

    with pytest.raises(UserError, match="sees the channels intensity, but the task net sees none"):
        compare_task_net(scans, Extent(), [8], loss=distance, weights=path, **SMALL)


@pytest.mark.parametrize(
    ("net", "loss", "said"),
    [
        (Extent(), None, "loss must be a function"),
        (3, distance, "task_net must be a run, a model or a torch.nn.Module, got int"),
        ("pointnet.modelnet40", distance, "loss is for a module of your own"),
        (nn.Linear(5, 2), distance, r"Linear fails on clouds of 64 points with 3 columns"),
    ],
)
def test_net_or_loss_of_another_kind_is_refused(net, loss, said, scans):
    with pytest.raises(UserError, match=said):
        compare_task_net(scans, net, [8], loss=loss, **SMALL)


def test_module_of_ones_own_is_evaluated_and_sizes_are_compared_once(scans):
    net = nn.Sequential(nn.Dropout(0.9), Extent()).train()

    result = compare_task_net(scans, net, [16, 8, 16], loss=distance, **SMALL)

    assert not net.training
    whole = result.frame[result.frame.files == "all"]
    assert whole[whole.method == "all points"].loss.max() == 0
    assert len(whole[whole.method == "random"]) == 2 * 3


def test_loss_of_a_batch_or_of_each_cloud_has_the_same_mean(scans):
    def mean(output, batch):
        return distance(output, batch).mean()

    of_clouds = compare_task_net(scans, Extent(), [8], loss=distance, **SMALL)
    of_batches = compare_task_net(scans, Extent(), [8], loss=mean, **SMALL)

    assert of_batches.frame.loss.to_list() == pytest.approx(of_clouds.frame.loss.to_list())


def test_loss_that_is_infinite_is_refused(scans):
    def endless(output, batch):
        return output.sum() * float("inf")

    with pytest.raises(UserError, match=r"the loss of Extent must be finite; .* it is -?inf"):
        compare_task_net(scans, Extent(), [8], loss=endless, **SMALL)
