"""The methods of a comparison, and how they are saved."""

from pathlib import Path

import pandas as pd
import pytest
import torch

from mops_lightning import FMOPSNet, MOPSNet, load
from mops_lightning.channels import NO_CHANNELS, Channel, PointChannels
from mops_lightning.errors import UserError
from mops_lightning.files.task_net import keep
from mops_lightning.files.task_net.methods import FPS_FARTHEST, Trained, Untrained, _names
from mops_lightning.metrics.info import MetricInfo
from mops_lightning.ops.points import normalize_unit_sphere
from mops_lightning.samplers.base import Sampler
from mops_lightning.samplers.by_budget import rows_in_unit_sphere
from mops_lightning.zoo.names import UNTRAINED


@pytest.mark.parametrize("name", [*UNTRAINED, FPS_FARTHEST])
def test_saved_method_chooses_the_points_that_were_scored(name, tmp_path, rng):
    points = torch.rand(2, 100, 3, generator=rng)
    clouds = normalize_unit_sphere(points)
    scored = Untrained(name)
    methods = [Untrained("fps"), scored]
    choices = [
        keep.Choice(16, name),
        keep.Choice(32, "fps"),
    ]

    keep.save(tmp_path / "best.safetensors", choices, methods, seed=3)
    sampler = load(tmp_path / "best")

    output = sampler(clouds, 16)
    expected = scored.rows(clouds, 16, seed=3)
    assert torch.equal(output.indices, expected)


def test_sizes_that_were_not_compared_take_the_form_of_farthest_points_kept_most_often(
    tmp_path, rng
):
    clouds = normalize_unit_sphere(torch.rand(2, 100, 3, generator=rng))
    methods = [Untrained("fps"), Untrained(FPS_FARTHEST)]
    choices = [
        keep.Choice(8, "fps"),
        keep.Choice(16, FPS_FARTHEST),
        keep.Choice(32, FPS_FARTHEST),
    ]

    keep.save(tmp_path / "best.safetensors", choices, methods, seed=3)
    sampler = load(tmp_path / "best")

    for m, method in ((8, methods[0]), (20, methods[1])):
        assert torch.equal(sampler(clouds, m).indices, method.rows(clouds, m, seed=3))


ACCURACY = MetricInfo("accuracy", unit="%", scale=100.0, higher_is_better=True)


def test_method_that_is_better_on_the_first_half_alone_is_rejected():
    scores = [
        # m, method, on the half for choosing, on the other half
        (16, "fps", 0.5, 0.5),
        (16, "random", 0.9, 0.4),
        (16, "voxel", 0.4, 0.4),
        (32, "fps", 0.5, 0.5),
        (32, "poisson", 0.9, 0.9),
        (32, "voxel", 0.4, 0.4),
    ]
    rows = []
    for draw in (0, 1):
        more = 0.001 * draw
        for m, name, choosing, checking in scores:
            rows.append((draw, "choosing", m, name, choosing + more))
            rows.append((draw, "checking", m, name, checking + more))
    frame = pd.DataFrame(rows, columns=["draw", "files", "m", "method", "score"])
    methods = [Untrained(name) for name in ("fps", "random", "voxel", "poisson")]

    few, many = keep.choose(frame, ACCURACY, methods)

    assert few.method == "fps"
    assert few.line == "16 points: fps; random was 10 percentage points worse on the other half"
    assert many.method == "poisson"
    assert many.line.endswith("40 percentage points better than FPS on the other half")


def test_rejected_method_is_replaced_by_the_better_farthest_points_of_the_first_half():
    scores = {
        "choosing": {"fps": 0.5, FPS_FARTHEST: 0.4, "random": 0.9},
        "checking": {"fps": 0.4, FPS_FARTHEST: 0.5, "random": 0.3},
    }
    rows = []
    for draw in (0, 1):
        for half, of_half in scores.items():
            for name, value in of_half.items():
                rows.append((draw, half, 16, name, value + 0.001 * draw))
    frame = pd.DataFrame(rows, columns=["draw", "files", "m", "method", "score"])
    methods = [Untrained(name) for name in scores["choosing"]]

    (choice,) = keep.choose(frame, ACCURACY, methods)

    assert (choice.method, choice.rejected) == ("fps", "random")
    assert choice.line == (
        "16 points: fps; random was 20 percentage points worse on the other half"
    )


def test_names_of_several_samplers_are_their_own_or_numbered():
    given: list[str | Sampler] = [
        "runs/small",
        "other/small",
        "zoo/random",
        "zoo/large",
        FMOPSNet(8),
    ]

    assert _names(given) == ["small_1", "small_2", "random_3", "large", "FMOPSNet"]
    assert _names(["runs/small"]) == ["trained"]


def test_sampler_in_memory_is_evaluated_at_every_size_that_it_was_trained_for():
    sampler = FMOPSNet(16).train()

    method = Trained(sampler, "mine", NO_CHANNELS)

    assert not method.sampler.training
    assert [method.takes(m) for m in (1, 15, 16, 17)] == [True, True, True, False]
    of_one_size = Trained(MOPSNet(16), "mine", NO_CHANNELS)
    assert [of_one_size.takes(m) for m in (15, 16, 17)] == [False, True, False]


def test_sampler_sees_channels_scaled_as_in_its_own_training(rng):
    of_net = PointChannels([Channel("intensity", 10.0, 5.0)])
    own = PointChannels([Channel("intensity", 100.0, 50.0)])
    torch.manual_seed(0)
    sampler = FMOPSNet(16, point_channels=own).eval()
    sampler.queries.weight.data *= 100  # samples depend on the channels
    places = normalize_unit_sphere(torch.rand(4, 200, 3, generator=rng))
    intensity = 3000 * torch.rand(4, 200, 1, generator=rng)
    clouds = torch.cat([places, (intensity - 10) / 5], 2)

    rows = Trained(sampler, "mine", of_net).rows(clouds, 16, 0)

    of_sampler = torch.cat([places, (intensity - 100) / 50], 2)
    assert torch.equal(rows, rows_in_unit_sphere(sampler, of_sampler, 16))
    assert not torch.equal(rows, rows_in_unit_sphere(sampler, clouds, 16))


def test_channels_of_two_samplers_are_those_that_one_of_them_has():
    channels = PointChannels([Channel("intensity", 10.0, 5.0)])
    others = PointChannels([Channel("intensity", 11.0, 5.0)])

    assert keep._common(channels, NO_CHANNELS) == channels
    assert keep._common(NO_CHANNELS, channels) == channels
    assert keep._common(channels, channels) == channels
    with pytest.raises(UserError, match="trained with other statistics of the channels"):
        keep._common(channels, others)


def test_file_of_a_saved_sampler_has_its_suffix_once(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")

    assert keep.file_of("best") == Path("best.safetensors")
    assert keep.file_of("a/best.safetensors") == Path("a/best.safetensors")
    assert keep.file_of("best.v2") == Path("best.v2.safetensors")
    assert keep.file_of("~/best") == Path("/home/me/best.safetensors")


def test_scores_are_ordered_by_size_and_draw_without_all_points():
    rows = [
        (1, "choosing", 16, "fps", 0.4),
        (0, "choosing", 16, "fps", 0.3),
        (0, "choosing", 8, "fps", 0.1),
        (1, "choosing", 8, "fps", 0.2),
        (0, "choosing", 0, "all points", 0.9),
        (0, "checking", 8, "fps", 0.5),
        (1, "checking", 8, "fps", 0.6),
    ]
    frame = pd.DataFrame(rows, columns=["draw", "files", "m", "method", "score"])

    assert keep.by_size(frame, "choosing") == {8: {"fps": [0.1, 0.2]}, 16: {"fps": [0.3, 0.4]}}
    assert list(keep.by_size(frame, "choosing")) == [8, 16]
    assert keep.by_part(frame) == {
        8: {"fps": [0.1, 0.2, 0.5, 0.6]},
        16: {"fps": [0.3, 0.4]},
    }
