"""What every sampler guarantees; ``tests/support/samplers.py`` lists them."""

import pytest
import torch
from torch.testing import assert_close

from mops_lightning import GumbelSampler, MOPSNet, Sampler, SNet
from mops_lightning.errors import UserError
from mops_lightning.ops.points import gather_points
from tests.support.samplers import SAMPLERS

SEEDED = ["random", "fps", "poisson", "normal_space"]
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
B, N, M = 3, 60, 8


@pytest.fixture(params=SAMPLERS)
def make(request):
    """Return a function that builds the sampler in eval mode, with the same weights every time."""

    def build(m=M, dtype=torch.float32):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            return SAMPLERS[request.param](m).to(dtype).eval()

    return build


@pytest.fixture
def clouds(randn):
    return randn(B, N, 3)


def lattice(rng):
    """Distinct points with coordinates k/4, so that most distances are tied."""
    steps = torch.arange(5) / 4
    grid = torch.cartesian_prod(steps, steps, steps)
    clouds = []
    for _ in range(B):
        order = torch.randperm(125, generator=rng)
        clouds.append(grid[order[:N]])
    return torch.stack(clouds)


def as_sets(points):
    return [sorted(cloud) for cloud in points.tolist()]


def test_input_of_wrong_type_raises(make, clouds):
    with pytest.raises(UserError, match=r"must be a torch\.Tensor, got ndarray"):
        make()(clouds.numpy())
    if make().learned:
        with pytest.raises(UserError, match=r"must be torch\.float32 like the sampler's weights"):
            make()(clouds.half())
    for m in (8.0, 0, True):
        with pytest.raises(UserError, match=f"m must be a whole number of at least 1, got {m}"):
            make(m=m)
    for m in (8.0, True):
        with pytest.raises(UserError, match=f"whole number, got {m}"):
            make()(clouds, m)


@pytest.mark.parametrize("training", [True, False])
def test_autocast_keeps_dtype(make, training, clouds):
    sampler = make().train(training)
    with torch.autocast("cpu", torch.bfloat16):
        half = sampler(clouds)
        assert sampler(clouds.bfloat16()).points.dtype == torch.bfloat16
    assert half.points.dtype == torch.float32
    if half.matrix is not None:
        assert_close(half.matrix.dense().mT @ clouds, half.points)
    if isinstance(sampler, MOPSNet | SNet):  # others choose, and may choose another point
        assert_close(half.points, sampler(clouds).points, atol=0.05, rtol=0.05)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_output_has_shape_dtype_and_device(make, clouds, dtype, device):
    points = clouds.to(device, dtype)
    sampler = make(dtype=dtype).to(device)

    output = sampler(points)

    assert output.points.shape == (B, M, 3)
    assert output.points.dtype == dtype
    assert output.points.device == points.device
    assert torch.isfinite(output.points).all()
    for loss in output.losses.values():
        assert loss.ndim == 0
    if output.indices is not None:
        assert output.indices.shape == (B, M)
        assert output.indices.dtype == torch.int64
        assert output.indices.device == points.device


@pytest.mark.parametrize("cloud", ["random", "lattice"])
def test_indices_are_distinct_rows_of_input(make, clouds, cloud, rng):
    points = clouds if cloud == "random" else lattice(rng)

    output = make()(points)

    if output.indices is None:
        pytest.skip("generates its points")
    assert torch.equal(output.points, gather_points(points, output.indices))
    for rows in output.indices.tolist():
        assert len(set(rows)) == M


def test_several_sizes_equal_single_sizes_and_are_nested_where_declared(make, clouds):
    sampler = make()
    if not sampler.flexible:
        return
    whole = sampler(clouds).points

    outputs = sampler.sample_sizes(clouds, (M, 1, M - 3))

    for m, output in outputs.items():
        alone = sampler(clouds, m)
        assert_close(output.points, alone.points)
        if sampler.nested:
            assert_close(output.points, whole[:, :m])


def test_sampler_without_sample_raises(clouds):
    with pytest.raises(NotImplementedError):
        Sampler(M)(clouds)


def test_result_does_not_depend_on_default_device(make, clouds):
    sampler = make()

    with torch.device("meta"):
        output = sampler(clouds)

    expected = sampler(clouds)
    assert torch.equal(output.points, expected.points)


@pytest.mark.parametrize("m", [0, -1, M + 1])
def test_size_out_of_range_raises(make, clouds, m):
    sampler = make()

    with pytest.raises(UserError, match=f"m must be .*{M}.* got {m}"):
        sampler(clouds, m)


def test_size_above_number_of_points_raises(make, clouds):
    sampler = make()
    too_few = clouds[:, : M - 1]

    with pytest.raises(UserError, match=f"N={M - 1}, got m={M}"):
        sampler(too_few)


def test_other_size_needs_flexible_sampler(make, clouds):
    sampler = make()
    if not sampler.flexible:
        with pytest.raises(UserError, match=f"m must be {M}, .* got {M - 3}"):
            sampler(clouds, M - 3)
        return
    for m in (1, M - 3, M):
        output = sampler(clouds, m)
        unchecked = sampler.sample(clouds, m)
        of_this_size = make(m)(clouds)

        assert output.points.shape == (B, m, 3)
        assert unchecked.points.shape == (B, m, 3)
        assert_close(output.points, of_this_size.points)


@pytest.mark.parametrize(
    ("points", "named"),
    [
        (torch.zeros(N, 3), "shape"),
        (torch.zeros(B, N, 2), "shape"),
        (torch.zeros(B, 1, N, 3), "shape"),
        (torch.zeros(0, N, 3), "at least one"),
        (torch.zeros(B, 0, 3), "at least one"),
        (torch.zeros(B, N, 3, dtype=torch.int64), "floating point, got torch.int64"),
        (torch.full((B, N, 3), torch.nan), "finite"),
        (torch.full((B, N, 3), -torch.inf), "finite"),
        (torch.zeros(B, N, 3).index_fill(1, torch.tensor(5), torch.nan), "finite"),
    ],
)
def test_invalid_input_raises(make, points, named):
    sampler = make()

    with pytest.raises(UserError, match=f"points must .*{named}"):
        sampler(points)


@pytest.mark.parametrize("cloud", ["random", "lattice"])
def test_sample_is_permutation_invariant(make, clouds, cloud, rng):
    points = clouds if cloud == "random" else lattice(rng)
    sampler = make()
    order = torch.randperm(N, generator=rng)

    sampled = sampler(points).points
    sampled_in_order = sampler(points[:, order]).points

    if sampler.learned:
        assert_close(sampled_in_order, sampled, atol=1e-5, rtol=0)
    else:
        assert as_sets(sampled_in_order) == as_sets(sampled)


@pytest.mark.parametrize("cloud", ["random", "lattice"])
def test_sample_is_independent_of_batch(make, clouds, cloud, rng):
    points = clouds if cloud == "random" else lattice(rng)
    points[1, 5:9] = points[1, 4]  # copies in one cloud must not affect another
    sampler = make()

    together = sampler(points)

    for b in range(B):
        alone = sampler(points[b : b + 1])
        if sampler.learned:
            assert_close(alone.points[0], together.points[b], atol=1e-5, rtol=0)
        else:
            assert torch.equal(alone.points[0], together.points[b])
        if alone.indices is not None:
            assert torch.equal(alone.indices[0], together.indices[b])


def test_sample_is_deterministic_without_side_effects(make, clouds):
    before = clouds.clone()
    state = torch.random.get_rng_state()
    sampler = make()
    another = make()

    first = sampler(clouds)
    second = sampler(clouds)
    of_another = another(clouds)

    assert torch.equal(first.points, second.points)
    assert torch.equal(first.points, of_another.points)
    assert torch.equal(clouds, before)
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize("name", SEEDED)
def test_seed_changes_sample(name, rng):
    clouds = lattice(rng)

    def sample(seed):
        sampler = SAMPLERS[name](M, seed=seed)
        return as_sets(sampler(clouds).points)

    assert sample(1) == sample(1)
    assert sample(1) != sample(2)


def test_size_of_all_points_returns_all(make, clouds):
    sampler = make(m=N)

    output = sampler(clouds)

    assert output.points.shape == (B, N, 3)
    if output.indices is not None:
        assert as_sets(output.points) == as_sets(clouds)


@pytest.mark.parametrize("distinct", [1, 3])
def test_coincident_points_give_valid_sample(make, distinct, randn):
    place = torch.arange(N) % distinct
    points = randn(B, distinct, 3)[:, place]
    sampler = make()

    output = sampler(points)

    assert torch.isfinite(output.points).all()
    if isinstance(sampler, SNet):
        return  # its points are not restricted to the convex hull
    largest = points.amax(1, keepdim=True)
    smallest = points.amin(1, keepdim=True)
    assert (output.points <= largest + 1e-6).all()
    assert (output.points >= smallest - 1e-6).all()
    if output.indices is not None:
        for rows in output.indices.tolist():
            assert len(set(rows)) == M


def test_gradients_are_correct(make, randn):
    points = randn(1, 9, 3, dtype=torch.float64, requires_grad=True)
    sampler = make(m=3, dtype=torch.float64)

    def sampled(points):
        return sampler(points).points

    rows = sampler(points).indices
    if rows is not None:  # gradients flow through the chosen points only
        (gradient,) = torch.autograd.grad(sampled(points).sum(), points)
        expected = torch.zeros_like(gradient)
        expected[0, rows[0]] = 1.0
        assert torch.equal(gradient, expected)
    if sampler.generates and not isinstance(sampler, GumbelSampler):  # it chooses in evaluation
        assert torch.autograd.gradcheck(sampled, (points,))
        parameters = dict(sampler.named_parameters())
        parameters.pop("temperature", None)  # SampleNet's has an effect in training only
        total = sampled(points).square().sum()
        gradients = torch.autograd.grad(total, list(parameters.values()))
        joined = torch.cat([gradient.flatten() for gradient in gradients])
        assert torch.isfinite(joined).all()
        assert (joined != 0).any()


GRAPHS = ["mops", "fmops", "snet", "samplenet", "samplenet-progressive"]


# torch's own tracing of an autograd function
@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")
@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("training", [True, False])
def test_compiles_to_one_graph(name, training, clouds):
    torch.compiler.reset()
    sampler = SAMPLERS[name](M).train(training)
    compiled = torch.compile(sampler, backend="eager", fullgraph=True)

    with torch.no_grad():
        expected = sampler(clouds)
        output = compiled(clouds)

    assert_close(output.points, expected.points)
    assert_close(output.losses, expected.losses)


class Generated(torch.nn.Module):
    def __init__(self, sampler):
        super().__init__()
        self.sampler = sampler

    def forward(self, points):
        return self.sampler(points).points


@pytest.mark.parametrize("name", GRAPHS)
def test_exported_program_generates_the_same_points(name, clouds, tmp_path):
    sampler = SAMPLERS[name](M).eval()
    path = tmp_path / "sampler.pt2"
    with torch.no_grad():
        program = torch.export.export(Generated(sampler), (clouds,))
        torch.export.save(program, path)

        loaded = torch.export.load(path).module()

        assert_close(loaded(clouds), sampler(clouds).points)
