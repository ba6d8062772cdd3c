"""Procedural scans: what is on the floor, what a scanner sees, channels, seeds and errors."""

from typing import Any

import numpy as np
import pytest
import torch

from mops_lightning.data.procedural.scenes import scan_of_shape
from mops_lightning.data.scans_of_shapes import scans_of_shapes
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY
from mops_lightning.records.run_record import read
from mops_lightning.samplers.fps import FPSSampler
from tests.support.command_line import TINY_ANY_DATA, done, runs

SMALL: dict[str, Any] = {
    "n_points": 128,
    "train_per_class": 2,
    "test_per_class": 1,
    "classes": ["cup", "stool"],
}


def scan(class_name="chair", n_points=2000, outliers=0.06, noise=0.0, number=0):
    return scan_of_shape(class_name, n_points, outliers, noise, seed=0, split=0, number=number)


# Content


def test_scans_have_classes_and_parts_in_the_unit_sphere():
    data = scans_of_shapes(**SMALL)

    assert data.class_names == ("cup", "stool")
    assert data.part_names == (
        "vessel",
        "handle",
        "saucer",
        "seat",
        "leg",
        "floor",
        "clutter",
        "outlier",
    )
    assert data.train.points.shape == (4, 128, 3)
    assert data.train.labels.tolist() == [0, 0, 1, 1]
    assert data.test.parts is not None
    assert data.test.parts.shape == (2, 128)
    largest = data.train.points.norm(dim=2).amax(1)
    means = data.train.points.mean(1)
    assert largest.allclose(torch.ones(4))
    assert means.abs().max() < 1e-6


def test_scans_number_the_parts_of_both_splits_as_their_names_say():
    """Of 600 points each: the floor is lowest, the parts are those of the class."""
    data = scans_of_shapes(600, 1, 2, ["stool", "table"], outliers=0.0, noise=0.0)

    assert data.part_names == ("seat", "leg", "top", "floor", "clutter", "outlier")
    seat, leg, top, floor, clutter, _ = range(6)
    for clouds, count in ((data.train, 1), (data.test, 2)):
        assert clouds.parts is not None
        stools = clouds.parts[:count].unique().tolist()
        tables = clouds.parts[count:].unique().tolist()
        assert stools == [seat, leg, floor, clutter]
        assert tables == [leg, top, floor, clutter]
        for points, parts in zip(clouds.points, clouds.parts, strict=True):
            height = points[:, 1]
            lowest = height[parts == floor].max()
            assert lowest <= height.min() + 1e-6


def test_scans_keep_the_fingerprint_of_published_models():
    """Models and cached task nets were trained on these scans; new ones need a new version."""
    data = scans_of_shapes(16, 1, 1, ["cup"])

    first_point = data.train.points[0, 0].tolist()
    assert first_point == pytest.approx([0.174488291, 0.232187167, 0.401292801], abs=1e-5)
    assert data.fingerprint[:12] == "3b3c95fb5670"


def test_scans_of_classes_without_parts_have_one_part_for_the_shape():
    arguments = {**SMALL, "classes": ["bowl", "stool"], "outliers": 0.3}

    data = scans_of_shapes(**arguments)

    assert data.part_names == ("object", "floor", "clutter", "outlier")
    parts = data.train.parts
    assert parts is not None
    assert (parts == 0).any(1).all()
    assert (parts == 1).any(1).all()
    plain = scans_of_shapes(**{**arguments, "classes": ["stool"]})
    of_stools = plain.part_names.index("outlier")
    assert plain.train.parts is not None
    outliers = parts[2:] == 3
    assert outliers.any()
    assert torch.equal(outliers, plain.train.parts == of_stools)


@pytest.mark.parametrize(
    ("name", "distances", "intensity", "counts"),
    [
        ("airplane", (0.4767, 0.0368, 0.4745), 0.3719, {"floor": 871, "clutter": 38}),
        ("bottle", (0.4065, 0.1162, 0.4631), 0.4081, {"floor": 729, "clutter": 35}),
        ("chair", (0.4061, 0.1367, 0.4704), 0.4668, {"floor": 739, "clutter": 62}),
        ("lamp", (0.4565, 0.1108, 0.4224), 0.2946, {"floor": 778, "clutter": 63}),
    ],
)
def test_scans_are_those_of_published_figures(name, distances, intensity, counts):
    """Means over four scans of 256 points; a change needs a new version of the generator."""
    scans = [scan(name, 256, 0.1, 0.01, number) for number in range(4)]

    points = np.concatenate([found.points for found in scans])
    parts = np.concatenate([found.parts for found in scans])
    intensities = np.concatenate([found.intensities for found in scans])
    assert np.abs(points).mean(0) == pytest.approx(distances, abs=1e-4)
    assert intensities.mean() == pytest.approx(intensity, abs=1e-4)
    assert {part: int((parts == part).sum()) for part in counts} == counts


SEEN = {
    "airplane": (
        (-0.0016, 0.0339, 0.1632),
        {"engine": 2, "hull": 30, "tail": 5, "wing": 19},
        (0.3780, 0.3604, 0.3305),
    ),
    "bottle": ((0.0474, 0.1136, -0.1799), {"object": 205}, (0.4024, 0.3971, 0.2990)),
    "chair": (
        (0.0836, 0.1338, -0.0479),
        {"arm": 7, "back": 94, "leg": 31, "seat": 36},
        (0.4692, 0.3204, 0.3211),
    ),
    "lamp": (
        (-0.0925, 0.1083, 0.0931),
        {"base": 44, "pole": 9, "shade": 84},
        (0.2583, 0.4597, 0.2946),
    ),
}
"""Over the same scans: the mean point, points on parts of the shape, and mean intensities."""


@pytest.mark.parametrize("name", SEEN)
def test_scans_see_the_sides_and_parts_of_published_ones(name):
    scans = [scan(name, 256, 0.1, 0.01, number) for number in range(4)]

    points = np.concatenate([found.points for found in scans])
    parts = np.concatenate([found.parts for found in scans])
    intensities = np.concatenate([found.intensities for found in scans])
    middle, counts, intensities_of_surroundings = SEEN[name]
    assert points.mean(0) == pytest.approx(middle, abs=1e-4)
    assert {part: int((parts == part).sum()) for part in counts} == counts
    means = [intensities[parts == part].mean() for part in ("floor", "clutter", "outlier")]
    assert means == pytest.approx(intensities_of_surroundings, abs=1e-4)


def test_scan_without_noise_has_its_points_on_surfaces():
    found = scan(outliers=0.0)

    floor = found.parts == "floor"
    chair = np.isin(found.parts, ("seat", "back", "leg", "arm"))
    clutter = found.parts == "clutter"
    height = found.points[:, 1]
    extent = np.ptp(found.points[chair], axis=0)
    assert abs(height[floor]).max() < 1e-9
    assert height[~floor].min() > -1e-9
    assert extent.max() <= 1 + 1e-9
    assert floor.sum() + chair.sum() + clutter.sum() == 2000


def test_scan_sees_no_floor_under_a_bottle():
    found = scan("bottle", 4000, outliers=0.0)

    bottle = found.points[found.parts == "object"]
    middle = (bottle.min(0) + bottle.max(0)) / 2
    radius = np.ptp(bottle[:, 0]) / 2
    from_middle = found.points - middle
    distances = np.hypot(from_middle[:, 0], from_middle[:, 2])
    above = distances < radius / 2
    assert above.sum() > 20
    assert set(found.parts[above]) == {"object"}


def test_scan_outliers_are_at_most_the_share_and_off_the_floor():
    shares = []
    for number in range(12):
        found = scan("cup", 1000, outliers=0.1, number=number)
        outliers = found.parts == "outlier"
        shares.append(outliers.mean())
        assert len(found.points) == 1000

    assert max(shares) <= 0.1
    assert 0.02 < np.mean(shares) < 0.08


def test_scan_noise_moves_points_along_the_rays():
    still = scan(outliers=0.0)
    moved = scan(outliers=0.0, noise=0.01)

    height = moved.points[moved.parts == "floor", 1]
    assert 0.002 < height.std() < 0.01
    assert still.points.shape == moved.points.shape


def test_scan_intensity_falls_with_the_angle_of_incidence():
    found = scan("shelf", 4000, outliers=0.0)

    floor = found.parts == "floor"
    assert found.intensities.min() >= 0
    assert found.intensities.max() <= 1
    # Scanners are low: the floor far from all of them is seen at the flattest angle.
    assert found.intensities[floor].std() > 0.03


def test_scans_farthest_points_take_outliers_first():
    data = scans_of_shapes(256, 8, 1, ["chair"])
    parts = data.train.parts
    assert parts is not None
    outlier = data.part_names.index("outlier")

    rows = FPSSampler(32)(data.train.points).indices

    assert rows is not None
    parts_of_farthest = parts.gather(1, rows)
    among_all = (parts == outlier).double().mean()
    among_farthest = (parts_of_farthest == outlier).double().mean()
    assert among_farthest > 2 * among_all


# Channels


def test_scans_have_intensity_and_normals_as_channels():
    plain = scans_of_shapes(**SMALL)
    data = scans_of_shapes(**SMALL, features=["intensity", "normals"])

    points = data.train.points
    assert data.channels.features == ("intensity", "normals")
    assert points.shape == (4, 128, 7)
    assert torch.equal(points[..., :3], plain.train.points)
    intensity = points[..., 3]
    assert abs(intensity.mean()) < 1e-4
    assert intensity.std() == pytest.approx(1, abs=1e-2)
    lengths = points[..., 4:].norm(dim=2)
    assert lengths.allclose(torch.ones(4, 128), atol=1e-5)
    assert data.fingerprint != plain.fingerprint


def test_scans_normals_of_the_floor_point_up():
    data = scans_of_shapes(1024, 1, 1, ["sofa"], outliers=0.0, features=["normals"])
    parts = data.train.parts
    assert parts is not None

    points = data.train.points[0]
    is_floor = parts[0] == data.part_names.index("floor")
    upward = points[is_floor, 4]
    assert upward.median() > 0.97


def test_scans_normals_point_upwards():
    data = scans_of_shapes(400, 1, 1, ["sofa"], features=["normals"])

    upward = data.train.points[..., 4]
    assert upward.min() >= -1e-6


# Reproducibility


def test_scans_depend_on_seed_and_not_on_counts():
    larger = {**SMALL, "train_per_class": 3, "classes": ["bowl", "cup", "stool"]}
    first = scans_of_shapes(**SMALL)
    again = scans_of_shapes(**SMALL)
    more = scans_of_shapes(**larger)
    other = scans_of_shapes(**SMALL, seed=1)

    assert torch.equal(first.train.points[:2], more.train.points[3:5])
    assert torch.equal(first.train.points, again.train.points)
    assert not torch.equal(first.train.points, other.train.points)
    assert not torch.equal(first.train.points[0], first.test.points[0])


def test_scans_fingerprint_depends_on_arguments():
    variants: list[dict[str, Any]] = [
        {},
        {"n_points": 65},
        {"outliers": 0.0},
        {"noise": 0.02},
        {"features": ["intensity"]},
        {"seed": 1},
    ]

    prints = set()
    for variant in variants:
        arguments = {**SMALL, **variant}
        prints.add(scans_of_shapes(**arguments).fingerprint)

    assert len(prints) == len(variants)


def test_scans_from_cache_equal_made_ones(tmp_path):
    arguments = {**SMALL, "features": ["normals"], "cache": tmp_path}
    made = scans_of_shapes(**arguments)
    (file,) = tmp_path.iterdir()
    written = file.stat().st_mtime_ns

    again = scans_of_shapes(**arguments)
    read_from_file = file.stat().st_mtime_ns == written
    beginning = file.read_bytes()[:1000]
    file.write_bytes(beginning)
    repaired = scans_of_shapes(**arguments)

    assert read_from_file
    assert torch.equal(again.train.points, made.train.points)
    assert torch.equal(repaired.train.points, made.train.points)
    assert again.channels == made.channels
    assert repaired.channels == made.channels


def test_scans_cache_loses_what_a_killed_run_left(tmp_path):
    left = tmp_path / f"{TEMPORARY}scans-x.npz"
    left.write_bytes(b"half")

    scans_of_shapes(**SMALL, cache=tmp_path)

    assert not left.exists()


def test_scans_keep_global_random_state():
    def states():
        of_numpy = str(np.random.get_state(legacy=False))  # noqa: NPY002
        of_torch = torch.get_rng_state().tolist()
        return of_numpy, of_torch

    before = states()
    scans_of_shapes(**SMALL)

    assert states() == before


# Errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"outliers": 1.0}, "outliers must be a share from 0 to below 1"),
        ({"outliers": True}, "outliers must be a share"),
        ({"noise": -0.1}, "noise must be a number of at least 0"),
        ({"noise": float("nan")}, "noise must be a number of at least 0"),
        ({"noise": float("inf")}, "noise must be a number of at least 0"),
        ({"features": ["colour"]}, "scans of shapes have intensity, normals, curvature"),
        ({"n_points": 0}, "n_points must be a whole number of at least 1"),
        ({"classes": ["sofas"]}, "unknown class 'sofas'. Did you mean 'sofa'"),
    ],
)
def test_scans_bad_argument_is_refused(arguments, message):
    arguments = {**SMALL, **arguments}

    with pytest.raises(UserError, match=message):
        scans_of_shapes(**arguments)


# A run


@pytest.mark.parametrize(
    ("task", "classes", "score"),
    [
        ("classification", ["dataset.classes=[chair,vase,lamp]"], "accuracy"),
        ("segmentation", [], "mean_iou"),
    ],
)
def test_scans_run_with_channels_by_plain_defaults(task, classes, score, tmp_path):
    chosen = [f"task={task}", "dataset=scans_of_shapes", "dataset.features=[intensity]"]
    tiny = ["dataset.train_per_class=1", "dataset.test_per_class=1", "val_fraction=0"]

    done([*chosen, *classes, *TINY_ANY_DATA, *tiny], tmp_path)

    (run,) = runs(tmp_path)
    record = read(run)
    assert 0 <= record.metrics[f"test/generated/{score}"] <= 1
