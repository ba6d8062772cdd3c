import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.metrics.registration import RotationError
from mops_lightning.nets.plane_icp import PlaneICP, surface_normals
from mops_lightning.ops.rigid import Motion, identity_motion, motion_of_vectors
from mops_lightning.seeding import generator
from mops_lightning.tasks.scan_registration import ScanRegistration
from mops_lightning.types import SampleOutput
from tests.ops.test_stability import box


@pytest.fixture
def clouds():
    boxes = [box(400, seed) for seed in range(3)]
    return torch.from_numpy(np.stack(boxes)).float() / 4


def task(**settings):
    return ScanRegistration(PlaneICP(), **settings)


def batch_of(clouds, **settings):
    generators = [generator(7, row) for row in range(len(clouds))]
    return task(**settings).make_batch(clouds, generators)


def test_halves_share_no_point_and_target_is_moved(clouds):
    batch = batch_of(clouds)

    source, target = batch.points.chunk(2)
    translation = batch.translation[:, None]
    motion = Motion(batch.quaternion, batch.translation)
    axes = torch.eye(3).expand(3, 3, 3)
    rotation = motion.apply(axes) - translation
    target_before = (target - translation) @ torch.linalg.inv(rotation)
    together = torch.cat([source, target_before], 1)
    for found, cloud in zip(together, clouds, strict=True):
        distances, rows = cKDTree(cloud).query(found)
        assert np.max(distances) < 1e-5
        assert np.sort(rows).tolist() == list(range(400))


def test_starts_are_within_their_limits(clouds):
    many = clouds.repeat(50, 1, 1)

    batch = batch_of(many, angle=15, shift=0.1)

    angles = angles_of(batch)
    shifts = torch.linalg.vector_norm(batch.translation, dim=1)
    assert 14 < angles.max() <= 15
    assert 0.09 < shifts.max() <= 0.1


def test_step_with_all_points_finds_the_motion():
    cloud = torch.from_numpy(box(3000)).float() / 4
    batch = batch_of(cloud[None])

    result = task().step(batch, batch.points)

    error = RotationError.of(result.predictions, result.targets)
    assert error.item() < 1


def test_sample_of_the_target_is_not_used(clouds):
    batch = batch_of(clouds)
    source, target = batch.points.chunk(2)
    sample = batch.points[:, :50]

    found = task().predict(batch, sample)

    expected = PlaneICP()(source[:, :50], target)
    assert torch.equal(found.quaternion, expected.quaternion)


def plain_residuals(source, target, moved=None, most=0.3):
    """Return the distances to the planes of the nearest points, cut off at the largest one.

    ``moved``: where the source was when the nearest points were found; None: where it is.
    """
    if moved is None:
        moved = source
    distances, rows = cKDTree(target).query(moved)
    apart = (source - target[rows]).double()
    normals = surface_normals(target[None])[0][rows].double()
    residuals = (apart * normals).sum(1).abs()
    residuals[torch.from_numpy(distances) > most] = most
    return residuals


def test_residuals_without_motion_equal_a_plain_form(clouds):
    batch = batch_of(clouds)

    residuals = task().residuals(batch)

    source, target = batch.points.chunk(2)
    aligned = Motion(batch.quaternion, batch.translation).apply(source)
    for number in range(3):
        expected = plain_residuals(aligned[number], target[number])
        found = residuals[number, 0].double()
        assert_close(found, expected, atol=1e-5, rtol=0)


def turned_about_random_axes(directions, sizes, angle, shift):
    """Return motions from six numbers for directions and two shares of the largest sizes."""
    motions = []
    for numbers, (share_of_angle, share_of_shift) in zip(directions, sizes, strict=True):
        axis = F.normalize(numbers[:3], dim=0)
        along = F.normalize(numbers[3:], dim=0)
        radians = share_of_angle * np.radians(angle)
        turn = Rotation.from_rotvec(radians * axis)
        motions.append((turn, share_of_shift * shift * along))
    return motions


def test_residuals_of_both_halves_follow_motions_that_grow_to_those_of_a_start(clouds):
    module = task(angle=40.0, shift=0.3, max_distance=0.2)
    batch = batch_of(clouds)
    torch.manual_seed(5)

    residuals = module.residuals(batch)

    source, target = batch.points.chunk(2)
    aligned = Motion(batch.quaternion, batch.translation).apply(source)
    halves = torch.cat([aligned, target])
    others = torch.cat([target, aligned])
    assert residuals.shape == (6, 4, 200)
    torch.manual_seed(5)
    for number, share in enumerate([0, 1 / 3, 2 / 3, 1]):
        sizes = share * torch.rand(6, 2)
        motions = turned_about_random_axes(torch.randn(6, 6), sizes, angle=40.0, shift=0.3)
        for row, (turn, shift) in enumerate(motions):
            moved = turn.apply(halves[row]) + shift.numpy()
            expected = plain_residuals(halves[row], others[row], moved, most=0.2)
            found = residuals[row, number].double()
            is_same = (found - expected).abs() < 1e-5
            assert is_same.double().mean() > 0.98  # a tie may be broken in another way


def test_pairs_of_scans_depend_on_their_own_generators_only(clouds):
    together = batch_of(clouds)

    generators = [generator(7, row) for row in range(3)]
    sources, targets = together.points.chunk(2)
    for row in range(3):
        alone = task().make_batch(clouds[row : row + 1], [generators[row]])
        source, target = alone.points
        assert torch.equal(source, sources[row])
        assert_close(target, targets[row])
        assert torch.equal(alone.quaternion[0], together.quaternion[row])


def test_halves_of_an_odd_number_of_points_leave_one_out(clouds):
    batch = batch_of(clouds[:, :301])

    assert batch.points.shape == (6, 150, 3)


def test_starts_turn_and_shift_by_sizes_of_their_own(clouds):
    turned = batch_of(clouds, angle=15, shift=0)
    shifted = batch_of(clouds, angle=0, shift=0.1)
    both = batch_of(clouds, angle=15, shift=0.15)

    shifts = both.translation.norm(dim=1)
    assert (turned.translation == 0).all()
    assert (angles_of(shifted) == 0).all()
    # With one number for both, their quotients would be equal.
    assert not torch.allclose(angles_of(both) / 15, shifts / 0.15, atol=0.01)


def angles_of(batch):
    """Return the angles of the starts, in degrees."""
    start = Motion(batch.quaternion, batch.translation)
    still = identity_motion(batch.points[: len(batch.quaternion)])
    return RotationError.of(start, still)


def test_loss_is_smallest_at_the_mean_residual(clouds):
    torch.manual_seed(3)
    batch = batch_of(clouds)
    state = torch.get_rng_state()
    best = task().residuals(batch).mean(1).log()

    losses = {}
    for offset in (-0.1, 0.0, 0.1):
        torch.set_rng_state(state)
        output = SampleOutput(batch.points, None, {}, log_residuals=best + offset)
        losses[offset] = float(task().sample_losses(batch, output)["residual"])

    assert losses[0.0] == pytest.approx(float(best.mean()) + 1, abs=1e-4)
    assert min(losses, key=losses.__getitem__) == 0.0


def test_samplers_without_residuals_have_no_such_loss(clouds):
    batch = batch_of(clouds)

    assert task().sample_losses(batch, SampleOutput(batch.points, None, {})) == {}


def test_clouds_of_one_point_and_wrong_limits_raise(clouds):
    with pytest.raises(UserError, match="two points or more, got 1"):
        batch_of(clouds[:, :1])
    with pytest.raises(UserError, match="angle must be at least 0"):
        task(angle=-1)
    with pytest.raises(UserError, match="max_distance must be a number above 0"):
        task(max_distance=0.0)


def test_rotation_vectors_turn_as_scipys():
    none = [0.0, 0.0, 0.0]
    tiny = [1e-8, 0.0, 0.0]
    large = [0.3, -2.0, 1.0]
    vectors = torch.tensor([none, tiny, large], dtype=torch.float64)
    translation = torch.zeros(3, 3, dtype=torch.float64)

    motion = motion_of_vectors(vectors, translation)

    rotation = Rotation.from_rotvec(vectors.numpy())
    expected = rotation.as_quat(scalar_first=True)
    assert motion.quaternion.numpy() == pytest.approx(expected, abs=1e-12)
