import itertools
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from mops_lightning.errors import UserError
from mops_lightning.ops.emd import earth_movers_distance, solve_assignments


def plain_emd(points, others):
    """Try all bijections."""
    best = []
    for p, q in zip(points, others, strict=True):
        means = []
        for order in itertools.permutations(range(len(p))):
            distances = (p - q[list(order)]).norm(dim=1)
            means.append(distances.mean())
        best.append(min(means))
    return torch.stack(best)


def clouds(rng, *shape):
    return torch.randn(2, *shape, 3, dtype=torch.float64, generator=rng)


@pytest.mark.parametrize("n", [1, 2, 5, 6])
def test_emd_equals_best_bijection(n, rng):
    points, others = clouds(rng, 3, n)

    distances = earth_movers_distance(points, others)

    assert_close(distances, plain_emd(points, others))


def test_emd_in_blocks_improves_in_four_rounds_by_default(rng):
    points, others = clouds(rng, 2, 200)

    by_default = earth_movers_distance(points, others, block=32)

    expected = earth_movers_distance(points, others, block=32, rounds=4)
    assert torch.equal(by_default, expected)


def kinds(n, rng):
    """Return typical pairs of clouds of a reconstruction: surfaces, a dense cluster, a copy."""
    sphere, again = F.normalize(clouds(rng, 1, n), dim=3)
    noise, flat = clouds(rng, 1, n)
    order = torch.randperm(n, generator=rng)
    near = sphere + 0.05 * noise
    sides = torch.tensor([1.0, 0.3, 0.02])
    return {
        "surface": (sphere, again),
        "cluster": (sphere, 0.1 * noise),
        "copy": (sphere, near[:, order]),
        "plane": (sphere, flat * sides),
    }


@pytest.mark.parametrize("kind", ["surface", "cluster", "copy", "plane"])
@pytest.mark.parametrize(("block", "rounds", "bound"), [(64, 2, 1.17), (128, 8, 1.08)])
def test_emd_in_blocks_is_tight_upper_bound(kind, block, rounds, bound, rng):
    points, others = kinds(512, rng)[kind]

    exact = earth_movers_distance(points, others).item()
    near = earth_movers_distance(points, others, block, rounds).item()

    assert exact * (1 - 1e-9) <= near < bound * exact


@pytest.mark.parametrize("block", [None, 7])
def test_assignment_is_permutation(block, rng):
    points, others = clouds(rng, 3, 61)
    points[1] = 0.5
    others[2] = points[2]

    rows = solve_assignments(points, others, block)
    again = solve_assignments(points, others, block)

    for rows_of_cloud in rows.tolist():
        assert sorted(rows_of_cloud) == list(range(61))
    assert torch.equal(again, rows)
    if block is None:
        assert earth_movers_distance(points, others)[2] == 0


@pytest.mark.parametrize("block", [None, 4])
def test_emd_gradcheck(block, rng):
    points, others = clouds(rng, 2, 9)
    points.requires_grad_()
    others.requires_grad_()

    def distance(points, others):
        return earth_movers_distance(points, others, block)

    assert torch.autograd.gradcheck(distance, (points, others), eps=1e-7)


def test_emd_of_equal_clouds_has_finite_gradients(rng):
    points, _ = clouds(rng, 2, 9)
    same = points.clone().requires_grad_()

    distance = earth_movers_distance(same, points).sum()
    (gradient,) = torch.autograd.grad(distance, same)

    assert torch.isfinite(gradient).all()


def test_emd_keeps_dtype(rng):
    points, others = clouds(rng, 2, 20)

    of_double = earth_movers_distance(points, others)
    of_single = earth_movers_distance(points.float(), others.float())
    of_half = earth_movers_distance(points.half(), others.half())

    assert_close(of_single, of_double.float())
    assert of_half.dtype == torch.float16


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"others": torch.zeros(2, 6, 3)}, r"same N, got \(2, 5, 3\) and \(2, 6, 3\)"),
        ({"points": torch.zeros(5, 3), "others": torch.zeros(5, 3)}, r"both be \(B, N, 3\)"),
        ({"block": 1}, "block must be at least 2, got 1"),
        ({"rounds": -1}, "rounds must be at least 0, got -1"),
        ({"workers": 0}, "workers must be at least 1, got 0"),
    ],
)
def test_emd_invalid_argument_raises(change, message):
    given = {"points": torch.zeros(2, 5, 3), "others": torch.zeros(2, 5, 3), **change}
    with pytest.raises(UserError, match=message):
        earth_movers_distance(**given)


def test_workers_same_assignment_and_exit_with_parent(tmp_path, rng):
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\n"
        "if __name__ == '__main__':\n"
        "    import torch\n"
        "    from mops_lightning.ops import workers\n"
        "    from mops_lightning.ops.emd import solve_assignments\n"
        "    points, others = torch.load(sys.argv[1])\n"
        "    for block in (None, 64):\n"
        "        shared = solve_assignments(points, others, block, 1, workers=2)\n"
        "        assert torch.equal(shared, solve_assignments(points, others, block, 1))\n"
        "    print(*workers.pool(2)._processes, flush=True)\n"
        "    input()\n"
    )
    torch.save(tuple(clouds(rng, 24, 350)), tmp_path / "clouds.pt")
    command = [sys.executable, script, tmp_path / "clouds.pt"]
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, text=True) as process:
        assert process.stdout is not None
        pids = [int(pid) for pid in process.stdout.readline().split()]
        assert len(pids) == 2
        assert all(Path(f"/proc/{pid}").exists() for pid in pids)
        process.kill()
    deadline = time.monotonic() + 20
    while any(alive(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in pids)


def alive(pid):
    """Return whether a process runs; an exited one may stay a zombie until its parent reaps it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
@pytest.mark.parametrize("block", [None, 16])
def test_emd_of_cloud_that_is_not_finite_is_not_finite(value, block, randn):
    points = randn(2, 40, 3)
    others = points.clone()
    others[1, 7] = value

    found = earth_movers_distance(points, others, block)

    assert found[0] == 0
    assert not found[1].isfinite()
    assert points.isfinite().all()
