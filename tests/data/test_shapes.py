"""The procedural dataset: content, reproducibility, difficulty, cache and errors."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from mops_lightning.data.procedural import sampled
from mops_lightning.data.procedural.mesh_parts import join, turned
from mops_lightning.data.procedural.sampled import BUILDERS
from mops_lightning.data.shapes import ASYMMETRIC, CLASSES, shapes
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
    return (
        torch.equal(first.train.points, second.train.points)
        and torch.equal(first.train.labels, second.train.labels)
        and torch.equal(first.test.points, second.test.points)
        and torch.equal(first.test.labels, second.test.labels)
        and first.fingerprint == second.fingerprint
    )


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
    assert torch.allclose(largest, torch.ones(()), atol=1e-6)
    assert clouds.points.mean(1).abs().max() < 1e-6


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

    above_floor = points[:, 1].double() - points[:, 1].double().min()
    height = 2 * (above_floor / above_floor.max()).numpy()
    is_floor = height < 1e-6
    assert is_floor.mean() == pytest.approx(1 / 5, abs=0.01)
    wall = height[~is_floor]
    counts, _ = np.histogram(wall, 4, (0, 2))
    assert counts / len(wall) == pytest.approx([0.25, 0.25, 0.25, 0.25], abs=0.02)


def test_shapes_many_points_and_single_point():
    many = shapes(100_000, 1, 1, ["teapot"])
    assert many.train.points.shape == (1, 100_000, 3)
    one = shapes(1, 1, 1, ["teapot"])
    assert torch.equal(one.train.points, torch.zeros(1, 1, 3))


# Reproducibility


def test_shapes_depend_on_seed():
    assert same(shapes(**SMALL), shapes(**SMALL))
    other = shapes(**SMALL, seed=1)
    assert not torch.equal(other.train.points, shapes(**SMALL).train.points)


def test_shapes_are_independent_of_counts():
    few = shapes(**SMALL)
    more = shapes(64, 5, 3, ["bowl", "cup", "stool", "vase"])
    for split in ("train", "test"):
        small = getattr(few, split)
        large = getattr(more, split)
        for name in few.class_names:
            expected = small.points[small.labels == few.class_names.index(name)]
            found = large.points[large.labels == more.class_names.index(name)]
            assert torch.equal(found[: len(expected)], expected)


def test_shapes_differ_within_class_and_between_splits(dataset):
    extents = torch.cat([_extents(dataset.train), _extents(dataset.test)])
    assert len(extents.unique(dim=0)) == len(extents)


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
        return str(np.random.get_state(legacy=False)), torch.get_rng_state().tolist()  # noqa: NPY002

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
    prints = [shapes(**{**SMALL, **variant}).fingerprint for variant in variants]
    assert len(set(prints)) == len(variants)
    assert all(len(text) == 64 for text in prints)
    assert shapes(**{**SMALL, "classes": ["stool", "cup"]}).fingerprint == prints[0]


# Difficulty


def _extents(clouds):
    return clouds.points.amax(1) - clouds.points.amin(1)


# Cache


def test_shapes_cache_is_written_and_read(tmp_path):
    fresh = shapes(**SMALL)
    assert same(shapes(**SMALL, cache=tmp_path / "new"), fresh)
    (path,) = (tmp_path / "new").iterdir()
    # Changed clouds in the file are returned, so it is read.
    train = fresh.train
    test = fresh.test
    parts: list[Any] = [train.parts, test.parts]
    np.savez(path, train.points / 2, test.points, *parts)
    again = shapes(**SMALL, cache=str(tmp_path / "new"))
    assert torch.equal(again.train.points, fresh.train.points / 2)
    assert torch.equal(again.train.labels, fresh.train.labels)


def test_shapes_damaged_cache_or_one_of_other_shapes_is_replaced(tmp_path):
    fresh = shapes(**SMALL, cache=tmp_path)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    damaged = [b"", b"not an archive", whole[: len(whole) // 2], whole[:-1], b"\x93NUMPY" + whole]
    for position in range(0, len(whole), len(whole) // 20):
        flipped = bytearray(whole)
        flipped[position] ^= 0xFF
        damaged.append(bytes(flipped))
    right = np.zeros((2, 64, 3), np.float32)
    for arrays in (
        {"train": np.zeros((4, 64, 3), np.float32)},
        {"train": np.zeros((4, 64, 3)), "test": right},
        {"train": np.zeros((3, 64, 3), np.float32), "test": right},
        {"train": np.array([{}], object), "test": right},
    ):
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
    with pytest.raises(UserError, match=rf"^{name}\b.*"):
        shapes(**{**SMALL, name: value})


def test_shapes_unwritable_cache_raises(tmp_path):
    (tmp_path / "file").write_text("")
    for cache in (tmp_path / "file", tmp_path / "file" / "below"):
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
    assert shapes(**few, classes="asymmetric").class_names == ASYMMETRIC


def test_shapes_nearest_bounding_boxes_do_not_identify_classes(dataset):
    train = _extents(dataset.train).double()
    test = _extents(dataset.test).double()

    _, nearest = cKDTree(train.numpy()).query(test.numpy())

    is_right = dataset.train.labels[nearest] == dataset.test.labels
    assert is_right.double().mean() < 0.55


def quadratic_terms(sizes):
    products = sizes * sizes.roll(1, 1)
    return torch.cat([torch.ones(len(sizes), 1), sizes, sizes**2, products], 1)


def test_shapes_quadratic_forms_of_bounding_boxes_do_not_identify_classes(dataset):
    train = quadratic_terms(_extents(dataset.train).double())
    test = quadratic_terms(_extents(dataset.test).double())
    targets = torch.nn.functional.one_hot(dataset.train.labels).double()

    weights = torch.linalg.lstsq(train, targets).solution

    predicted = (test @ weights).argmax(1)
    is_right = predicted == dataset.test.labels
    assert is_right.double().mean() < 0.55
