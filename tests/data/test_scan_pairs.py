import json
import shutil

import numpy as np
import pytest
import torch

from mops_lightning.data.formats.registry import read
from mops_lightning.data.loader import CloudLoader
from mops_lightning.data.pairs import Pairs
from mops_lightning.data.scan_pairs import scan_pairs
from mops_lightning.errors import UserError
from mops_lightning.losses.registration import quaternion_loss
from mops_lightning.nets.icp import ICP
from mops_lightning.ops.rigid import Motion, quaternion_to_matrix, rotation_angle
from mops_lightning.tasks.registration import Registration
from tests.support.command_line import TINY_ANY_DATA, call, runs
from tests.support.scans import moved, pose, room, views, write_log, write_poses, write_scans

POSES = [pose(seed) for seed in range(6)]
CHAIN = [(i, i + 1) for i in range(5)]


def write(folder, clouds, pairs=CHAIN):
    poses = POSES[: len(clouds)]
    write_scans(folder, clouds, poses)
    write_poses(folder / "poses.txt", poses)
    write_log(folder / "gt.log", poses, pairs)
    return folder


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    """Six overlapping views of a made-up room."""
    return write(tmp_path_factory.mktemp("room"), views(room(), 6))


@pytest.fixture(scope="module", params=["made-up room", "real room"])
def scan(request):
    """One scan, made up, or a real one where MOPS_DATA has it."""
    if request.param == "made-up room":
        return room()
    path = request.getfixturevalue("real_data") / "scans" / "redkitchen_000.ply"
    if not path.is_file():
        pytest.skip("MOPS_DATA has no scans/redkitchen_000.ply")
    return read(path, 1, 0).points[::80]


@pytest.fixture(scope="module")
def folder(scan, tmp_path_factory):
    """Six overlapping views of the scan."""
    return write(tmp_path_factory.mktemp("views"), views(scan, 6))


def load(folder, **settings):
    given = {"motions": "poses.txt", "scans": "scan_*", "n_points": 200, "crops": 2, **settings}
    return scan_pairs(folder, **given)


def truth(clouds):
    return Motion(clouds.pairs.quaternion, clouds.pairs.translation)


def both(data):
    """Return the clouds of both splits, training pairs first."""
    parts = zip(data.train.pairs, data.test.pairs, strict=True)
    return torch.cat([data.train.points, data.test.points]), type(data.train.pairs)(
        *map(torch.cat, parts)
    )


def farthest(points, others):
    """Return the largest distance of a point from the nearest of the others."""
    exact = "donot_use_mm_for_euclid_dist"
    return torch.cdist(points, others, compute_mode=exact).min(2).values.max()


def turned(motion):
    """Return the angles of rotations in degrees."""
    still = torch.eye(4)[:1].expand_as(motion.quaternion)
    return torch.rad2deg(rotation_angle(motion.quaternion, still))


@pytest.mark.parametrize("layout", ["poses.txt", "gt.log"])
def test_scan_pairs_return_the_motions_put_in(tmp_path, scan, layout):
    # The same points from four places, so that the motion also follows from the points.
    folder = write(tmp_path, [scan] * 4, [(0, 1), (1, 2), (2, 3)])
    data = load(folder, motions=layout, n_points=len(scan), crops=1)
    source, pairs = both(data)
    assert (data.notes["left_out_pairs"], len(source)) == (1, 2)
    for row, (i, j) in enumerate([(0, 1), (2, 3)]):
        start, end = (j, i) if layout == "gt.log" else (i, j)
        true = np.linalg.inv(POSES[end]) @ POSES[start]
        rotation = quaternion_to_matrix(pairs.quaternion[row].double()).numpy()
        np.testing.assert_allclose(rotation, true[:3, :3], atol=1e-6)
        stated = data.notes[("train_pairs", "test_pairs")[row]]["translation"]
        assert stated == pytest.approx([np.linalg.norm(true[:3, 3])] * 3, rel=1e-3)
        # The translation in the files' own coordinates: q = s·q' + b, and p = 0 at the origin.
        place = rotation @ pairs.origin[row].double().numpy() + pairs.translation[row].numpy()
        b = moved(scan, np.linalg.inv(POSES[end])).mean(0)
        np.testing.assert_allclose(pairs.scale[row].item() * place + b, true[:3, 3], atol=1e-5)
    there = Motion(pairs.quaternion, pairs.translation).apply(source)
    assert farthest(there, pairs.target) < 1e-5
    rest = ICP()(there, pairs.target)
    assert turned(rest).max() < 0.01
    assert rest.translation.abs().max() < 1e-4


def test_scan_pairs_are_in_unit_sphere(folder):
    for crop in ({}, {"crop": "nearest"}, {"crop": "cube", "crop_size": 2.5, "n_points": 60}):
        source, pairs = both(load(folder, **crop))
        clouds = torch.stack([source, pairs.target], 1)
        assert clouds.shape[0] == 8
        assert clouds.mean(2).abs().max() < 1e-5
        assert clouds.norm(dim=3).amax((1, 2)).allclose(torch.ones(8))


def test_icp_stays_near_true_motion_of_partial_overlaps(folder):
    source, pairs = both(load(folder, n_points=400))
    rest = ICP()(Motion(pairs.quaternion, pairs.translation).apply(source), pairs.target)
    assert turned(rest).max() < 5
    assert rest.translation.norm(dim=1).max() < 0.2


def test_scan_pairs_seed_repeats(made_up):
    for crop in ("whole", "nearest"):
        first, again, other = (load(made_up, crop=crop, seed=seed) for seed in (3, 3, 4))
        assert first.fingerprint == again.fingerprint != other.fingerprint
        assert torch.equal(first.train.points, again.train.points)
        assert not torch.equal(first.train.points, other.train.points)


def test_scan_pairs_crops_share_their_centre(made_up):
    data = load(made_up, crop="nearest", n_points=100)
    centre, true = data.train.pairs.origin[:, None], truth(data.train)
    for clouds, place in (
        (data.train.points, centre),
        (data.train.pairs.target, true.apply(centre)),
    ):
        radius = (clouds - place).norm(dim=2)
        assert radius.min() < 0.25  # the centre is a point of the source
        assert radius.max() < 2
    assert data.notes["train_pairs"]["crop_overlap"][1] > 0.5


def test_scan_pairs_scan_is_in_one_split(made_up):
    data = load(made_up, gap=2, test_share=0.4, crops=1)
    # Pairs (0, 2) (1, 3) | (2, 4) (3, 5): the border leaves out what it cuts.
    assert data.notes["left_out_pairs"] == 2
    assert (len(data.train.points), len(data.test.points)) == (1, 1)
    assert data.notes["train_pairs"]["number"] == 1


def test_scan_pairs_linked_by_a_scan_are_held_out_together(made_up):
    pairs = [(0, 1), (1, 2), (3, 4)]
    write_log(made_up / "few.log", POSES, [*pairs, (4, 5)])
    sources = load(made_up, motions="few.log", test_share=0.3, crops=1).train.sources
    assert sources.tolist()[0] == sources.tolist()[1]


def test_scan_pairs_scenes_and_split_folders(made_up, tmp_path):
    for scene in ("train/hall", "train/yard", "test/hall"):
        shutil.copytree(made_up, tmp_path / scene)
    data = load(tmp_path, crops=1)
    assert data.class_names == ("test/hall", "train/hall", "train/yard")
    assert data.train.labels.tolist() == [1] * 5 + [2] * 5
    assert data.test.labels.tolist() == [0] * 5
    assert data.notes["left_out_pairs"] == 0


def test_scan_pairs_numbers_follow_names(tmp_path):
    cloud = room(100)
    shifted = [cloud + np.array([i, 0, 0]) for i in range(12)]  # scan_10 comes after scan_9
    write_scans(tmp_path, shifted, [np.eye(4)] * 12)
    still = np.tile(np.eye(4), (12, 1, 1))
    still[:, 0, 3] = -np.arange(12)
    write_poses(tmp_path / "poses.txt", still)
    data = load(tmp_path, n_points=100, crops=1)
    assert data.notes["test_pairs"]["overlap"] == data.notes["train_pairs"]["overlap"] == [1, 1, 1]


def test_scan_pairs_overlap_is_stated(tmp_path):
    strip = np.random.default_rng(0).uniform(0, 1, (4000, 3)) * (10, 1, 0.01)
    parts = [strip[(strip[:, 0] > a) & (strip[:, 0] < a + 4)] for a in (0, 2, 4, 6)]
    folder = write(tmp_path, parts, [(0, 1), (1, 2), (2, 3)])
    data = load(folder, overlap_distance=0.05)
    for split in ("train_pairs", "test_pairs"):
        assert data.notes[split]["overlap"] == pytest.approx([0.5] * 3, abs=0.06)
        assert data.notes[split]["crop_overlap"] == data.notes[split]["overlap"]


def test_scan_pairs_without_overlap_raise_or_are_left_out(tmp_path):
    clouds = views(room(), 6)
    clouds[0] = clouds[0] + 100
    folder = write(tmp_path, clouds)
    with pytest.raises(
        UserError, match=r"scan_0.* and .*scan_1.* do not overlap.*min_overlap=0\.1"
    ):
        load(folder)
    data = load(folder, min_overlap=0.1)
    assert data.notes["left_out_pairs"] == 2
    with pytest.raises(UserError, match=r"no train pair.*less than min_overlap"):
        load(
            write(tmp_path / "far", [cloud + 50 * i for i, cloud in enumerate(clouds)]),
            min_overlap=0.5,
        )


def test_scan_pairs_far_from_origin_keep_their_digits(tmp_path):
    poses = [matrix.copy() for matrix in POSES[:4]]
    for matrix in poses:
        matrix[:3, 3] += (-431_000, -5_412_000, 0)
    write_scans(tmp_path, [room(300)] * 4, poses)
    write_poses(tmp_path / "poses.txt", poses)
    data = load(tmp_path, n_points=300, crops=1)
    there = truth(data.train).apply(data.train.points)
    assert farthest(there, data.train.pairs.target) < 1e-5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"test_share": 0.0}, "test_share"),
        ({"overlap_distance": -1.0}, "overlap_distance must be above 0"),
        ({"min_overlap": 1.0}, "min_overlap must be at least 0 and below 1"),
        ({"crop": "cube"}, "crop_size.*crop=cube"),
        ({"crops": 0}, "crops must be at least 1"),
        ({"scans": "/x"}, "scans must be a pattern"),
        ({"scans": "none_*"}, "no cloud in .*none_"),
        ({"scans": "scan_[0-3]*"}, "6 poses, but there are 4 scans.*dataset.scans="),
        ({"motions": "nowhere.txt"}, "motions: no file nowhere.txt"),
        ({"calib": "nowhere.txt"}, "calib: no file nowhere.txt"),
        ({"n_points": 5000}, "points, fewer than dataset.n_points=5000"),
        ({"crop": "cube", "crop_size": 0.01}, "crop_size=0.01 is too small"),
        ({"gap": 5}, "motions: the 1 pairs of 6 scans cannot be split"),
    ],
)
def test_scan_pairs_invalid_argument_raises(made_up, settings, message):
    with pytest.raises(UserError, match=message):
        load(made_up, **settings)


def test_scan_pairs_task_errors_are_in_own_unit(made_up):
    data = load(made_up, crop="nearest")
    task = Registration(ICP(max_iterations=1), Pairs(0.0, 0.0), quaternion_loss)
    (batch,) = CloudLoader(data.test, 8, make_batch=task.make_batch)
    result = task.step(batch, batch.points)
    pairs = data.test.pairs
    # By hand: how far the predicted and the true motion move the centre of the crop apart.
    centre = pairs.origin[:, None]
    found = task.net(data.test.points, pairs.target)
    apart = (found.apply(centre) - truth(data.test).apply(centre))[:, 0].norm(dim=1)
    error = (result.predictions.translation - result.targets.translation).norm(dim=1)
    torch.testing.assert_close(error, apart * pairs.scale, atol=1e-4, rtol=1e-4)
    assert error.min() > 0


def test_scan_pairs_training_run_reports(made_up, tmp_path):
    data = [f"dataset.root={made_up}", "dataset.motions=gt.log", "dataset.scans=scan_*"]
    small = ["+task.net.feature_channels=[8,16]", "+task.net.head_channels=[16]", "dataset.crops=2"]
    given = ["task=registration", "dataset=scan_pairs", "learn=joint", "weights=null"]
    status, _, err = call([*TINY_ANY_DATA, *given, *data, *small], tmp_path)
    assert status == 0, err
    assert "test pairs: 1, overlap" in err
    (run,) = runs(tmp_path)
    record = json.loads((run / "result.json").read_text())
    assert record["notes"]["train_pairs"]["number"] == 3
    assert record["config"]["task"]["pairs"]["rotation"] == 0
    for readout in ("generated", "matched", "completed", "fps", "full"):
        assert record["metrics"][f"test/{readout}/translation_error"] > 0
