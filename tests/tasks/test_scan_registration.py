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
    """Three boxes of 400 points, 1.5 by 1 by 0.5 in size."""
    boxes = [box(400, seed) for seed in range(3)]
    points = np.stack(boxes) / 4
    return torch.from_numpy(points).float()


def task(**settings):
    net = PlaneICP()
    return ScanRegistration(net, **settings)


def batch_of(clouds, **settings):
    module = task(**settings)
    generators = [generator(7, row) for row in range(len(clouds))]
    return module.make_batch(clouds, generators)


def start_of(batch):
    """Return the motions from the sources onto their targets."""
    return Motion(batch.quaternion, batch.translation)


def test_halves_share_no_point_and_target_is_moved(clouds):
    batch = batch_of(clouds)

    source, target = batch.points.chunk(2)
    translation = batch.translation[:, None]
    axes = torch.eye(3).expand(3, 3, 3)
    moved_axes = start_of(batch).apply(axes)
    rotation = moved_axes - translation
    centred_target = target - translation
    target_before = centred_target @ torch.linalg.inv(rotation)
    together = torch.cat([source, target_before], 1)
    every_row = list(range(400))
    for points, cloud in zip(together, clouds, strict=True):
        tree = cKDTree(cloud)
        distances, rows = tree.query(points)
        assert np.max(distances) < 1e-5
        assert np.sort(rows).tolist() == every_row


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
    module = task()

    result = module.step(batch, batch.points)

    degrees = RotationError.of(result.predictions, result.targets)
    assert degrees.item() < 1


def test_sample_of_the_target_is_not_used(clouds):
    batch = batch_of(clouds)
    source, target = batch.points.chunk(2)
    sample = batch.points[:, :50]
    module = task()

    found = module.predict(batch, sample)

    net = PlaneICP()
    sample_of_source = source[:, :50]
    expected = net(sample_of_source, target)
    assert torch.equal(found.quaternion, expected.quaternion)


def plain_residuals(source, target, moved=None, most=0.3):
    """Return the distances to the planes of the nearest points, cut off at the largest one.

    ``moved``: where the source was when the nearest points were found; None: where it is.
    """
    if moved is None:
        moved = source
    tree = cKDTree(target)
    distances, rows = tree.query(moved)
    offsets = source - target[rows]
    (normals,) = surface_normals(target[None])
    along_normals = offsets.double() * normals[rows].double()
    residuals = along_normals.sum(1).abs()
    is_far = torch.from_numpy(distances) > most
    residuals[is_far] = most
    return residuals


def test_residuals_without_motion_equal_a_plain_form(clouds):
    batch = batch_of(clouds)

    module = task()

    residuals = module.residuals(batch, batch.points)

    source, target = batch.points.chunk(2)
    aligned = start_of(batch).apply(source)
    for number in range(3):
        expected = plain_residuals(aligned[number], target[number])
        found = residuals[number, 0].double()
        assert_close(found, expected, atol=1e-5, rtol=0)


def test_residuals_of_a_part_are_those_in_the_whole_pair(clouds):
    batch = batch_of(clouds)
    module = task()
    rows = torch.arange(0, 200, 3)
    torch.manual_seed(5)
    whole = module.residuals(batch, batch.points)
    torch.manual_seed(5)

    part = module.residuals(batch, batch.points[:, rows])

    assert_close(part, whole[:, :, rows])


def turned_about_random_axes(directions, sizes, angle, shift):
    """Return motions from six numbers for directions and two shares of the largest sizes."""
    motions = []
    largest_turn = np.radians(angle)
    for direction, (share_of_angle, share_of_shift) in zip(directions, sizes, strict=True):
        axis = F.normalize(direction[:3], dim=0)
        heading = F.normalize(direction[3:], dim=0)
        rotation_vector = share_of_angle * largest_turn * axis
        turn = Rotation.from_rotvec(rotation_vector)
        translation = share_of_shift * shift * heading
        motions.append((turn, translation))
    return motions


def test_residuals_of_both_halves_follow_motions_that_grow_to_those_of_a_start(clouds):
    module = task(angle=40.0, shift=0.3, max_distance=0.2)
    batch = batch_of(clouds)
    torch.manual_seed(5)

    residuals = module.residuals(batch, batch.points)

    assert residuals.shape == (6, 4, 200)
    source, target = batch.points.chunk(2)
    aligned = start_of(batch).apply(source)
    halves = torch.cat([aligned, target])
    others = torch.cat([target, aligned])
    shares = [0, 1 / 3, 2 / 3, 1]
    torch.manual_seed(5)
    for number, share in enumerate(shares):
        sizes = share * torch.rand(6, 2)
        directions = torch.randn(6, 6)
        motions = turned_about_random_axes(directions, sizes, angle=40.0, shift=0.3)
        for row, (turn, shift) in enumerate(motions):
            half = halves[row]
            moved = turn.apply(half) + shift.numpy()
            expected = plain_residuals(half, others[row], moved, most=0.2)
            found = residuals[row, number].double()
            errors = (found - expected).abs()
            is_same = errors < 1e-5
            share_of_same = is_same.double().mean()
            assert share_of_same > 0.98  # a tie may be broken in another way


def test_pairs_of_scans_depend_on_their_own_generators_only(clouds):
    module = task()

    together = batch_of(clouds)

    sources, targets = together.points.chunk(2)
    for row in range(3):
        cloud = clouds[row]
        alone = module.make_batch(cloud[None], [generator(7, row)])
        source, target = alone.points
        (quaternion,) = alone.quaternion
        assert torch.equal(source, sources[row])
        assert_close(target, targets[row])
        assert torch.equal(quaternion, together.quaternion[row])


def test_halves_of_an_odd_number_of_points_leave_one_out(clouds):
    odd = clouds[:, :301]

    batch = batch_of(odd)

    assert batch.points.shape == (6, 150, 3)


def test_starts_turn_and_shift_by_sizes_of_their_own(clouds):
    turned = batch_of(clouds, angle=15, shift=0)
    shifted = batch_of(clouds, angle=0, shift=0.1)
    both = batch_of(clouds, angle=15, shift=0.15)

    assert (turned.translation == 0).all()
    assert (angles_of(shifted) == 0).all()
    # With one number for both, the shares of the limits would be equal.
    shares_of_angle = angles_of(both) / 15
    shares_of_shift = both.translation.norm(dim=1) / 0.15
    assert not torch.allclose(shares_of_angle, shares_of_shift, atol=0.01)


def angles_of(batch):
    """Return the angles of the starts, in degrees."""
    start = start_of(batch)
    sources, _ = batch.points.chunk(2)
    still = identity_motion(sources)
    return RotationError.of(start, still)


def test_loss_is_smallest_at_the_mean_residual(clouds):
    torch.manual_seed(3)
    batch = batch_of(clouds)
    module = task()
    state = torch.get_rng_state()
    mean_residuals = module.residuals(batch, batch.points).mean(1)
    best = mean_residuals.log()

    losses = {}
    for offset in (-0.1, 0.0, 0.1):
        torch.set_rng_state(state)
        shifted = best + offset
        output = SampleOutput(batch.points, None, {}, log_residuals=shifted)
        losses_by_name = module.sample_losses(batch, batch.points, output)
        losses[offset] = losses_by_name["residual"].item()

    expected = best.mean().item() + 1
    best_offset = min(losses, key=losses.__getitem__)
    assert losses[0.0] == pytest.approx(expected, abs=1e-4)
    assert best_offset == 0.0


def test_samplers_without_residuals_have_no_such_loss(clouds):
    batch = batch_of(clouds)
    without_residuals = SampleOutput(batch.points, None, {})
    module = task()

    losses = module.sample_losses(batch, batch.points, without_residuals)

    assert losses == {}


def test_clouds_of_one_point_and_wrong_limits_raise(clouds):
    single_points = clouds[:, :1]

    with pytest.raises(UserError, match="two points or more, got 1"):
        batch_of(single_points)
    with pytest.raises(UserError, match="angle must be at least 0"):
        task(angle=-1)
    with pytest.raises(UserError, match="shift must be at least 0"):
        task(shift=-0.1)
    with pytest.raises(UserError, match="max_distance must be a number above 0"):
        task(max_distance=0.0)


def test_rotation_vectors_turn_as_scipys():
    none = [0.0, 0.0, 0.0]
    tiny = [1e-8, 0.0, 0.0]
    large = [0.3, -2.0, 1.0]
    vectors = np.array([none, tiny, large])
    translations = torch.zeros(3, 3, dtype=torch.float64)

    motion = motion_of_vectors(torch.from_numpy(vectors), translations)

    rotations = Rotation.from_rotvec(vectors)
    expected = rotations.as_quat(scalar_first=True)
    found = motion.quaternion.numpy()
    assert found == pytest.approx(expected, abs=1e-12)
