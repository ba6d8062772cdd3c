"""Runs on points with channels: trained, tested again, and loaded with their statistics."""

import shutil
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from mops_lightning import FPSSampler, MOPSNet, load
from mops_lightning.channels import Channel, PointChannels
from mops_lightning.config.compose import compose
from mops_lightning.data.formats.registry import WRITERS, read
from mops_lightning.data.formats.table import Table
from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.training.experiment import Experiment
from mops_lightning.training.run.channels import check_sampler, scaled_as_trained
from mops_lightning.training.run.make_experiment import make_experiment
from mops_lightning.zoo import weights
from mops_lightning.zoo.publish import add
from tests.support import downsample
from tests.support.command_line import TINY_ANY_DATA, done, refused, runs
from tests.support.training import small_dataset

SETTINGS = [
    *TINY_ANY_DATA,
    "dataset=clouds",
    "dataset.root=scans",
    "dataset.crops=4",
    "dataset.features=[intensity,normals]",
    "val_fraction=0",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clouds of two classes with an intensity and a part, in a folder that tests share."""
    folder = tmp_path_factory.mktemp("channels")
    for number in range(8):
        points = np.random.default_rng(number).normal(size=(120, 3)) * [3, 2, 1]
        columns = {
            "intensity": 100 + 10 * points[:, 0].astype(np.float32),
            "part": (points[:, 1] > 0).astype(np.int32),
        }
        path = folder / "scans" / ("car" if number % 2 else "tree") / f"{number}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        WRITERS[".ply"](path, Table(points, columns))
    return folder


@pytest.fixture(scope="module")
def trained(folder):
    """A run that trained a sampler, and its task net before."""
    done([*SETTINGS, "task=classification", "sampler=fmops", "sampler.m_max=8"], folder)
    (run,) = runs(folder)
    return run


@pytest.fixture
def with_intensity():
    """Small data whose points have one channel."""
    dataset = small_dataset()
    train, test = (
        clouds._replace(points=torch.cat([clouds.points, clouds.points[..., :1] ** 2], 2))
        for clouds in (dataset.train, dataset.test)
    )
    channels = PointChannels([Channel("intensity")])
    return replace(dataset, train=train, test=test, channels=channels)


def test_weights_know_the_statistics_of_the_training_split(trained):
    sampler: Any = load(trained)

    channels = sampler.point_channels
    assert channels.features == ("intensity", "normals")
    assert channels.columns[0].mean == pytest.approx(100, abs=5)
    assert channels.columns[0].scale == pytest.approx(30, abs=6)
    assert channels.columns[1][1:] == (0.0, 1.0)
    assert sampler.features.mlp.layers[0].weight.shape[1] == 7


def test_evaluation_of_the_same_data_repeats_the_scores(folder, trained):
    done([f"evaluate={trained}", "out=evaluated"], folder)

    (again,) = (folder / "evaluated").rglob("result.json")
    assert run_record.read(again.parent).metrics == run_record.read(trained).metrics


def test_normals_of_corrupted_test_clouds_turn_with_them(folder, trained, monkeypatch):
    seen: dict[int, torch.Tensor] = {}

    def clouds_of(*settings):
        with monkeypatch.context() as patched:
            patched.setattr(Experiment, "on_test_batch_end", note, raising=False)
            done([f"evaluate={trained}", "hydra.run.dir=tested", *settings], folder)
        shutil.rmtree(folder / "tested")
        return torch.cat([seen.pop(number) for number in sorted(seen)])

    def note(self, outputs, batch, number):
        seen[number] = batch.points

    plain = clouds_of()
    turned = clouds_of("test_corruption=rotation-5")

    for before, after in zip(plain, turned, strict=True):
        rotation = torch.linalg.lstsq(before[:, :3], after[:, :3]).solution
        assert (rotation - torch.eye(3)).abs().max() > 0.01
        torch.testing.assert_close(after[:, 4:], before[:, 4:] @ rotation, rtol=0, atol=1e-4)
        assert torch.equal(after[:, 3], before[:, 3])  # the intensity


def test_evaluation_with_features_in_another_order_is_refused(folder, trained):
    line = refused([f"evaluate={trained}", "dataset.features=[normals,intensity]"], folder)

    assert "was trained with the features intensity, normals, but dataset.features gives" in line
    assert "Set dataset.features=[intensity, normals]." in line


def test_evaluation_without_the_features_is_refused(folder, trained):
    line = refused(
        [f"evaluate={trained}", "dataset.features=null", "hydra.run.dir=without"], folder
    )

    assert "dataset.features gives none. Set dataset.features=[intensity, normals]." in line


def test_feature_that_a_file_lacks_is_refused_with_what_it_has(folder):
    line = refused([*SETTINGS, "dataset.features=[reflectance]"], folder)

    assert "dataset.features: scans/car/1.ply has no column 'reflectance'." in line
    assert "Allowed: curvature, intensity, normals, part." in line


def test_model_has_the_channels_of_its_run(trained, tmp_path):
    path = add(trained, "fmops.trees", tmp_path)

    model = load(path)

    assert model.point_channels == load(trained).point_channels
    cloud = torch.rand(50, 7)
    cloud[:, 4:] = torch.nn.functional.normalize(cloud[:, 4:], dim=1)
    assert model.downsample(cloud, 5)[0].shape == (5, 7)


@pytest.mark.parametrize(
    "chosen",
    [
        ["task=registration", "task.net.feature_channels=[16,32]", "sampler=mops"],
        ["task=reconstruction", "sampler=samplenet", "task.exact_up_to=null", "sampler.k=3"],
        ["task=segmentation", "dataset.label=part", "learn=joint", "sampler=gumbel"],
        ["task=classification", "learn=joint", "sampler=fps", "weights=null"],
    ],
)
def test_every_task_trains_with_channels(folder, chosen, tmp_path):
    augmented = ["++augment.sampler.rotate_up=z", "++augment.task.rotate_up=z", "pictures=2"]

    done([*SETTINGS, *augmented, f"dataset.root={folder / 'scans'}", *chosen], tmp_path)

    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert record.status == "completed"
    assert record.score is not None
    assert np.isfinite(record.score)


def test_pictures_take_the_colours_of_a_channel(folder, tmp_path):
    settings = [*SETTINGS, f"dataset.root={folder / 'scans'}", "pictures=1", "weights=null"]
    settings += ["task=classification", "learn=joint", "callbacks.pictures.colour=intensity"]

    done(settings, tmp_path)

    (run,) = runs(tmp_path)
    image = plt.imread(run / "pictures" / "clouds.png")[..., :3]
    saturated = (image.max(2) - image.min(2)) > 0.3
    left = saturated[:, : image.shape[1] // 4]
    assert left.sum() > 50  # the input, which is grey otherwise


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ([], "Allowed: intensity, normal_x,"),
        (["dataset.features=null"], "x, y and z only. dataset.features gives them channels."),
    ],
)
def test_colour_of_an_unknown_channel_is_refused(settings, said, folder):
    picture = ["pictures=1", "callbacks.pictures.colour=ring"]

    line = refused([*SETTINGS, *picture, *settings], folder)

    assert "callbacks.pictures.colour: no channel 'ring'" in line
    assert said in line


def test_net_without_channels_is_refused(folder):
    line = refused([*SETTINGS, "task=reconstruction", "weights=autoencoder.airplane"], folder)

    assert "weights: " in line
    assert "was trained without features, but dataset.features gives intensity" in line


def test_learned_sampler_without_channels_is_refused():
    dataset = replace(small_dataset(), channels=PointChannels([Channel("intensity")]))

    check_sampler(MOPSNet(8, point_channels=1), dataset)
    check_sampler(FPSSampler(8), dataset)
    with pytest.raises(UserError, match=r"^sampler: MOPSNet takes x, y and z only, but .* intensi"):
        check_sampler(MOPSNet(8), dataset)


@pytest.mark.parametrize(
    "name",
    [
        "covariance",
        "fps",
        "information",
        "normal_space",
        "poisson",
        "random",
        "serial",
        "steady",
        "voxel",
    ],
)
def test_sampler_without_learned_weights_sees_coordinates(name, with_intensity):
    cfg = compose([f"sampler={name}", "m=8", "learn=nothing"])
    points = with_intensity.test.points

    sampler: Any = make_experiment(cfg, with_intensity, {}).sampler

    output = sampler(points)

    expected = sampler(points[..., :3].contiguous())
    assert torch.equal(output.indices, expected.indices)
    assert output.points.shape == (len(points), 8, 4)


def test_net_without_an_argument_for_channels_is_refused(folder):
    line = refused([*SETTINGS, "task.net._target_=tests.support.plain_net.PlainNet"], folder)

    assert "task/net=own takes x, y and z only, but dataset.features gives intensity" in line


def test_real_airborne_scans_train_and_are_downsampled_with_intensity(real_data, tmp_path):
    scans = tmp_path / "scans"
    scans.mkdir()
    for name in ("autzen-thin.las", "4_6_crop.las"):
        shutil.copy(real_data(f"airborne/{name}"), scans)
    settings = ["task=segmentation", "dataset.label=classification", "learn=joint", "sampler=mops"]
    features = "dataset.features=[intensity,return_number,normals]"
    done([*SETTINGS, *settings, features, f"dataset.root={scans}"], tmp_path)
    (run,) = runs(tmp_path)
    small = tmp_path / "small.las"

    downsample.done(
        scans / "autzen-thin.las", small, "--weights", run, "--m", 8, "--readout", "generated"
    )

    before = read(scans / "autzen-thin.las", 9, 0).columns
    after = read(small, 9, 0).columns
    assert after["intensity"].dtype == before["intensity"].dtype
    assert before["intensity"].min() <= after["intensity"].min()
    assert after["intensity"].max() <= before["intensity"].max()
    normals = np.stack([after[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), np.ones(8), atol=1e-5)


def net_with_channels(folder, *columns):
    """Write the weights of a task net that was trained with channels, and return their file."""
    folder.mkdir()
    path = folder / weights.FILE
    channels = PointChannels(columns)
    weights.save(path, torch.nn.Linear(1, 1), {"learn": "task"}, {}, channels=channels)
    return path


@pytest.fixture
def data(with_intensity):
    """The same with other statistics."""
    return replace(with_intensity, channels=PointChannels([Channel("intensity", 10.0, 2.0)]))


@pytest.mark.parametrize(
    "setting",
    [
        "weights={}",
        "other_nets=[{}]",
        "recipe.warm_start={}",
        "pretrain_from={}",
    ],
)
def test_channels_are_scaled_as_a_given_net_was_trained(setting, data, tmp_path):
    path = net_with_channels(tmp_path / "net", Channel("intensity", 20.0, 4.0))

    scaled = scaled_as_trained(data, compose([setting.format(path)]), None)

    assert scaled.channels == PointChannels([Channel("intensity", 20.0, 4.0)])
    of_files = data.train.points[..., 3] * 2 + 10
    torch.testing.assert_close(scaled.train.points[..., 3], (of_files - 20) / 4)
    assert torch.equal(scaled.train.points[..., :3], data.train.points[..., :3])


def test_start_of_a_training_that_is_not_needed_scales_no_channel(data, tmp_path):
    path = net_with_channels(tmp_path / "net", Channel("intensity", 20.0, 4.0))

    cfg = compose([f"pretrain_from={path}", "weights=null"])

    assert scaled_as_trained(data, cfg, None) is data


def test_given_nets_of_other_statistics_are_refused(data, tmp_path):
    first = net_with_channels(tmp_path / "first", Channel("intensity", 20.0, 4.0))
    second = net_with_channels(tmp_path / "second", Channel("intensity", 20.0, 5.0))
    same = net_with_channels(tmp_path / "same", Channel("intensity", 20.0, 4.0))

    scaled_as_trained(data, compose([f"weights={first}", f"other_nets=[{same}]"]), None)
    with pytest.raises(UserError, match=r"^other_nets: .*second.* with other statistics of the"):
        scaled_as_trained(data, compose([f"weights={first}", f"other_nets=[{second}]"]), None)
