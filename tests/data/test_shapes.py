"""The procedural dataset: content, reproducibility, difficulty, cache and errors."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.data.procedural import sampled
from mops_lightning.data.procedural.mesh_parts import join, turned
from mops_lightning.data.procedural.sampled import BUILDERS
from mops_lightning.data.shapes import ASYMMETRIC, CLASSES, PARTS, shapes
from mops_lightning.errors import UserError
from mops_lightning.filesystem import TEMPORARY

SMALL: dict[str, Any] = {
    "n_points": 64,
    "train_per_class": 2,
    "test_per_class": 1,
    "classes": ["cup", "stool"],
}


@pytest.fixture(scope="module")
def dataset():
    return shapes(n_points=512, train_per_class=20, test_per_class=6)


def same(first, second):
    for split in ("train", "test"):
        clouds = getattr(first, split)
        others = getattr(second, split)
        if not torch.equal(clouds.points, others.points):
            return False
        if not torch.equal(clouds.labels, others.labels):
            return False
    return first.fingerprint == second.fingerprint


# Content


@pytest.mark.parametrize(("split", "count"), [("train", 20), ("test", 6)])
def test_shapes_are_labelled_and_in_unit_sphere(split, count, dataset):
    clouds = getattr(dataset, split)

    number = len(BUILDERS)
    assert clouds.points.shape == (count * number, 512, 3)
    assert clouds.points.dtype == torch.float32
    assert clouds.labels.dtype == torch.int64
    assert clouds.labels.bincount().tolist() == [count] * number
    largest = clouds.points.norm(dim=-1).amax(1)
    means = clouds.points.mean(1)
    assert torch.allclose(largest, torch.ones(()), atol=1e-6)
    assert means.abs().max() < 1e-6


def test_shapes_have_a_class_for_each_builder(dataset):
    assert dataset.class_names == CLASSES
    assert tuple(BUILDERS) == CLASSES
    assert len(CLASSES) >= 12


def test_shapes_points_are_uniform_by_area(monkeypatch):
    """A thin-walled cylinder, whose floor has a fifth of the area."""

    def cylinder(rng):
        floor = turned([(0, 0), (1, 0)], 64)
        wall = turned([(1, 0), (1, 2)], 64)
        return join([floor, wall])

    monkeypatch.setattr(sampled, "BUILDERS", {"bottle": cylinder})
    monkeypatch.setattr(sampled, "STRETCH", (0.0, 0.0, 0.0))

    points = shapes(40_000, 1, 1, ["bottle"]).train.points[0]

    y = points[:, 1].double().numpy()
    height = 2 * (y - y.min()) / np.ptp(y)
    is_floor = height < 1e-6
    assert is_floor.mean() == pytest.approx(1 / 5, abs=0.01)
    wall = height[~is_floor]
    counts, _ = np.histogram(wall, 4, (0, 2))
    shares = counts / len(wall)
    assert shares == pytest.approx([0.25, 0.25, 0.25, 0.25], abs=0.02)


def test_shapes_many_points_and_single_point():
    many = shapes(100_000, 1, 1, ["teapot"])
    single = shapes(1, 1, 1, ["teapot"])

    assert many.train.points.shape == (1, 100_000, 3)
    assert torch.equal(single.train.points, torch.zeros(1, 1, 3))


def test_shapes_parts_are_named_where_they_are():
    data = shapes(400, 3, 2, ["table", "airplane"])

    assert data.class_names == ("airplane", "table")
    assert data.part_names == ("hull", "wing", "tail", "engine", "top", "leg")
    for clouds, count in ((data.train, 3), (data.test, 2)):
        assert clouds.parts is not None
        assert clouds.parts.shape == (2 * count, 400)
        airplanes = clouds.parts[:count]
        tables = clouds.parts[count:]
        assert airplanes.unique().tolist() == [0, 1, 2, 3]
        assert tables.unique().tolist() == [4, 5]
        for points, parts in zip(clouds.points[count:], tables, strict=True):
            height = points[:, 1]
            assert height[parts == 4].mean() > height[parts == 5].mean() + 0.1
        for points, parts in zip(clouds.points, airplanes, strict=False):
            side = points[:, 0].abs()
            assert side[parts == 1].max() > 2 * side[parts == 0].max()


def test_shapes_have_no_parts_where_a_class_does_not_know_them():
    data = shapes(8, 1, 1, ["bowl", "table"])

    assert data.part_names == ()
    assert data.train.parts is None
    assert data.test.parts is None


def test_shapes_keep_the_fingerprint_of_published_task_nets():
    """Models and cached task nets were trained on these shapes; new ones need a new version."""
    data = shapes(16, 1, 1, ["cup"])

    first_point = data.train.points[0, 0].tolist()
    assert first_point == pytest.approx([-0.014166577, -0.312007785, 0.099837191], abs=1e-5)
    assert data.fingerprint[:12] == "62c97b4dc570"


PUBLISHED = {
    "airplane": (0.2041, 0.0713, 0.3824),
    "bed": (0.2710, 0.1217, 0.4788),
    "bottle": (0.2287, 0.4572, 0.2382),
    "bowl": (0.4012, 0.2203, 0.4013),
    "bucket": (0.3263, 0.3379, 0.3096),
    "chair": (0.2785, 0.2931, 0.2863),
    "cup": (0.3696, 0.3166, 0.3488),
    "desk": (0.3821, 0.2031, 0.2241),
    "goblet": (0.2112, 0.5110, 0.2172),
    "lamp": (0.1989, 0.6504, 0.1602),
    "shelf": (0.2898, 0.3854, 0.1523),
    "sofa": (0.4136, 0.2089, 0.3017),
    "stool": (0.2579, 0.3093, 0.2592),
    "table": (0.3766, 0.2171, 0.2861),
    "teapot": (0.3265, 0.2699, 0.2403),
    "vase": (0.2848, 0.4066, 0.2614),
}
"""Mean distances from the origin along x, y and z, over eight shapes of 128 points."""


@pytest.mark.parametrize("name", CLASSES)
def test_shapes_of_every_class_are_those_of_published_figures(name):
    """A change needs a new version of the generator: caches and figures are of these shapes."""
    clouds = [sampled.sampled_shape(name, 128, 0, 0, number)[0] for number in range(8)]

    means = np.abs(np.concatenate(clouds).astype(np.float64)).mean(0)

    assert means == pytest.approx(PUBLISHED[name], abs=1e-4)


# Reproducibility


def test_shapes_depend_on_seed():
    first = shapes(**SMALL)
    again = shapes(**SMALL)
    other = shapes(**SMALL, seed=1)

    assert same(first, again)
    assert not torch.equal(other.train.points, first.train.points)


def test_shapes_are_independent_of_counts():
    few = shapes(**SMALL)
    more = shapes(64, 5, 3, ["bowl", "cup", "stool", "vase"])
    for split in ("train", "test"):
        for name in few.class_names:
            expected = clouds_of_class(few, split, name)
            found = clouds_of_class(more, split, name)
            number = len(expected)
            assert torch.equal(found[:number], expected)


def clouds_of_class(data, split, name):
    clouds = getattr(data, split)
    label = data.class_names.index(name)
    return clouds.points[clouds.labels == label]


def extents_of(clouds):
    return clouds.points.amax(1) - clouds.points.amin(1)


def test_shapes_differ_within_class_and_between_splits(dataset):
    of_train = extents_of(dataset.train)
    of_test = extents_of(dataset.test)
    extents = torch.cat([of_train, of_test])
    different = extents.unique(dim=0)
    assert len(different) == len(extents)


def median_distance(points, others):
    distances, _ = cKDTree(others).query(points)
    return np.median(distances)


def test_shapes_form_is_independent_of_n_points():
    names = ["airplane", "chair", "lamp"]

    few = shapes(1000, 2, 1, names).train.points.numpy()
    many = shapes(4000, 2, 1, names).train.points.numpy()

    for row, form in enumerate(few):
        apart = [median_distance(form, other) for other in many]
        assert np.argmin(apart) == row
        assert apart[row] < 0.03


def test_shapes_keep_global_random_state():
    def states():
        of_numpy = str(np.random.get_state(legacy=False))  # noqa: NPY002
        of_torch = torch.get_rng_state().tolist()
        return of_numpy, of_torch

    before = states()

    shapes(**SMALL)

    assert states() == before


def test_shapes_fingerprint_depends_on_arguments():
    variants: list[dict[str, Any]] = [
        {},
        {"n_points": 65},
        {"train_per_class": 3},
        {"test_per_class": 2},
        {"classes": ["cup", "vase"]},
        {"seed": 1},
    ]
    other_order = {**SMALL, "classes": ["stool", "cup"]}

    prints = []
    for variant in variants:
        arguments = {**SMALL, **variant}
        prints.append(shapes(**arguments).fingerprint)

    assert len(set(prints)) == len(variants)
    assert {len(text) for text in prints} == {64}
    assert shapes(**other_order).fingerprint == prints[0]


# Cache


def test_shapes_cache_is_written_and_read(tmp_path):
    fresh = shapes(**SMALL)
    cache = tmp_path / "new"
    written = shapes(**SMALL, cache=cache)
    (path,) = cache.iterdir()
    # Changed clouds in the file are returned, so it is read.
    train = fresh.train
    test = fresh.test
    half = train.points / 2
    parts: list[Any] = [train.parts, test.parts]
    np.savez(path, half, test.points, *parts)

    again = shapes(**SMALL, cache=str(cache))

    assert same(written, fresh)
    assert torch.equal(again.train.points, half)
    assert torch.equal(again.train.labels, train.labels)
    assert again.test.parts is not None
    assert again.test.parts.tolist() == parts[1].tolist()


def test_shapes_damaged_cache_or_one_of_other_shapes_is_replaced(tmp_path):
    fresh = shapes(**SMALL, cache=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    half = len(whole) // 2
    damaged = [
        b"",
        b"not an archive",
        whole[:half],
        whole[:-1],
        b"\x93NUMPY" + whole,
    ]
    for position in range(0, len(whole), len(whole) // 20):
        flipped = bytearray(whole)
        flipped[position] ^= 0xFF
        damaged.append(bytes(flipped))
    test = np.zeros((2, 64, 3), np.float32)
    without_test = {"train": np.zeros((4, 64, 3), np.float32)}
    in_float64 = {"train": np.zeros((4, 64, 3)), "test": test}
    too_few = {"train": np.zeros((3, 64, 3), np.float32), "test": test}
    objects = {"train": np.array([{}], object), "test": test}
    for arrays in (without_test, in_float64, too_few, objects):
        np.savez(path, **arrays)
        damaged.append(path.read_bytes())
    for content in damaged:
        path.write_bytes(content)
        assert same(shapes(**SMALL, cache=tmp_path), fresh)
        assert list(tmp_path.iterdir()) == [path]
    path.write_bytes(damaged[1])
    (tmp_path / f"{TEMPORARY}left by a kill.npz").touch()
    shapes(**SMALL, cache=tmp_path)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == whole


# Errors and output


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_points", 0),
        ("n_points", "many"),
        ("n_points", 10.5),
        ("train_per_class", 0),
        ("test_per_class", -1),
        ("test_per_class", True),
        ("seed", -1),
        ("seed", None),
        ("classes", ["cupp"]),
    ],
)
def test_shapes_invalid_argument_raises(name, value):
    arguments = {**SMALL, name: value}

    with pytest.raises(UserError, match=rf"^{name}\b.*"):
        shapes(**arguments)


def test_shapes_unwritable_cache_raises(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    for cache in (file, file / "below"):
        with pytest.raises(UserError, match=r"^cache\b.*file"):
            shapes(**SMALL, cache=cache)


def test_shapes_print_nothing_without_terminal(capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")

    shapes(**SMALL)

    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", BUILDERS)
def test_builder_gives_valid_meshes(name):
    for seed in range(12):
        mesh = BUILDERS[name](np.random.default_rng(seed))
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.max() < len(mesh.vertices)
        assert (mesh.extents > 0.1).all()
        assert mesh.extents.max() < 4


def test_asymmetric_classes_are_a_choice_of_their_own():
    few: dict[str, Any] = {"n_points": 8, "train_per_class": 1, "test_per_class": 1}

    asymmetric = shapes(**few, classes="asymmetric")
    with_parts = shapes(**few, classes="parts")

    assert asymmetric.class_names == ASYMMETRIC
    assert with_parts.class_names == tuple(PARTS)


def test_shapes_nearest_bounding_boxes_do_not_identify_classes(dataset):
    train = extents_of(dataset.train).double()
    test = extents_of(dataset.test).double()

    _, nearest = cKDTree(train.numpy()).query(test.numpy())

    is_right = dataset.train.labels[nearest] == dataset.test.labels
    assert is_right.double().mean() < 0.55


def quadratic_terms(sizes):
    products = sizes * sizes.roll(1, 1)
    return torch.cat([torch.ones(len(sizes), 1), sizes, sizes**2, products], 1)


def test_shapes_quadratic_forms_of_bounding_boxes_do_not_identify_classes(dataset):
    train = quadratic_terms(extents_of(dataset.train).double())
    test = quadratic_terms(extents_of(dataset.test).double())
    targets = torch.nn.functional.one_hot(dataset.train.labels).double()

    weights = torch.linalg.lstsq(train, targets).solution

    predicted = (test @ weights).argmax(1)
    is_right = predicted == dataset.test.labels
    assert is_right.double().mean() < 0.55
