import itertools
import subprocess
import sys
import time
from pathlib import Path
from subprocess import PIPE

import numpy as np
import ot
import pytest
import torch
from scipy.optimize import linear_sum_assignment
from scipy.stats import wasserstein_distance

from mops_lightning.errors import UserError
from mops_lightning.ops.emd import earth_movers_distance, matching


def plain(points, others):
    """Try all bijections."""
    best = []
    for p, q in zip(points, others, strict=True):
        orders = itertools.permutations(range(len(p)))
        best.append(min((p - q[list(order)]).norm(dim=1).mean().item() for order in orders))
    return torch.tensor(best, dtype=points.dtype)


def clouds(rng, *shape):
    return torch.randn(2, *shape, 3, dtype=torch.float64, generator=rng)


@pytest.mark.parametrize("n", [1, 2, 5, 6])
def test_exact_distance_is_the_best_of_all_bijections(n, rng):
    points, others = clouds(rng, 3, n)
    torch.testing.assert_close(earth_movers_distance(points, others), plain(points, others))


def test_on_a_line_it_is_the_wasserstein_distance_of_scipy(rng):
    points, others = clouds(rng, 2, 200)
    points[..., 1:] = others[..., 1:] = 0
    want = [
        wasserstein_distance(p[:, 0].numpy(), q[:, 0].numpy())
        for p, q in zip(points, others, strict=True)
    ]
    torch.testing.assert_close(
        earth_movers_distance(points, others), torch.tensor(want, dtype=torch.float64)
    )


def kinds(n, rng):
    """Pairs of clouds as reconstruction meets them: surfaces, a start from a heap, a copy."""
    sphere, again = clouds(rng, 1, n)
    sphere, again = (cloud / cloud.norm(dim=2, keepdim=True) for cloud in (sphere, again))
    noise, flat = clouds(rng, 1, n)
    order = torch.randperm(n, generator=rng)
    return {
        "surface": (sphere, again),
        "heap": (sphere, 0.1 * noise),
        "copy": (sphere, sphere[:, order] + 0.05 * noise[:, order]),
        "plane": (sphere, flat * torch.tensor([1.0, 0.3, 0.02])),
    }


@pytest.mark.parametrize("kind", ["surface", "heap", "copy", "plane"])
@pytest.mark.parametrize(("block", "rounds", "bound"), [(64, 2, 1.17), (128, 8, 1.08)])
def test_distance_by_blocks_is_an_upper_bound_near_the_exact_one(kind, block, rounds, bound, rng):
    points, others = kinds(512, rng)[kind]
    exact = earth_movers_distance(points, others).item()
    near = earth_movers_distance(points, others, block, rounds).item()
    assert exact * (1 - 1e-9) <= near < bound * exact


def test_more_rounds_are_never_worse_and_one_block_is_exact(rng):
    points, others = kinds(300, rng)["surface"]
    values = [earth_movers_distance(points, others, 32, rounds).item() for rounds in range(6)]
    assert values == sorted(values, reverse=True)
    assert values[5] < values[0]
    one = earth_movers_distance(points, others, block=300)
    torch.testing.assert_close(one, earth_movers_distance(points, others))


@pytest.mark.parametrize("block", [None, 7])
def test_matchings_are_bijections_of_odd_and_coincident_clouds_too(block, rng):
    points, others = clouds(rng, 3, 61)
    points[1] = 0.5
    others[2] = points[2]
    match = matching(points, others, block)
    assert torch.equal(match.sort(1).values, torch.arange(61).expand(3, -1))
    assert torch.equal(matching(points, others, block), match)
    if block is None:
        assert earth_movers_distance(points, others)[2] == 0


@pytest.mark.parametrize("block", [None, 4])
def test_gradients(block, rng):
    points, others = (cloud.requires_grad_() for cloud in clouds(rng, 2, 9))
    assert torch.autograd.gradcheck(
        lambda a, b: earth_movers_distance(a, b, block), (points, others), eps=1e-7
    )
    same = points.detach().clone().requires_grad_()
    (gradient,) = torch.autograd.grad(earth_movers_distance(same, points).sum(), same)
    assert torch.isfinite(gradient).all()


def test_half_precision_and_float32_are_taken(rng):
    points, others = clouds(rng, 2, 20)
    exact = earth_movers_distance(points, others)
    torch.testing.assert_close(earth_movers_distance(points.float(), others.float()), exact.float())
    assert earth_movers_distance(points.half(), others.half()).dtype == torch.float16


def test_ten_thousand_points_take_little_memory_and_time(rng):
    points, others = kinds(10_000, rng)["surface"]
    value = earth_movers_distance(points, others, block=64, rounds=2).item()
    # What no bijection can beat: every point to the nearest one.
    from scipy.spatial import cKDTree

    lower = np.mean(cKDTree(others[0].numpy()).query(points[0].numpy())[0])
    assert lower < value < 4 * lower
    assert np.isfinite(value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"others": torch.zeros(2, 6, 3)}, r"same N, got \(2, 5, 3\) and \(2, 6, 3\)"),
        ({"block": 1}, "block must be at least 2 points, got 1"),
        ({"rounds": -1}, "rounds must not be negative, got -1"),
        ({"workers": 0}, "workers must be at least 1, or null for all cores, got 0"),
    ],
)
def test_bad_input_is_named(change, said):
    given = {"points": torch.zeros(2, 5, 3), "others": torch.zeros(2, 5, 3), **change}
    with pytest.raises(UserError, match=said):
        earth_movers_distance(**given)


def test_workers_give_the_same_matching_and_end_with_the_process_that_asked(tmp_path, rng):
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\n"
        "if __name__ == '__main__':\n"
        "    import torch\n"
        "    from mops_lightning.ops import workers\n"
        "    from mops_lightning.ops.emd import matching\n"
        "    points, others = torch.load(sys.argv[1])\n"
        "    for block in (None, 64):\n"
        "        shared = matching(points, others, block, 1, workers=2)\n"
        "        assert torch.equal(shared, matching(points, others, block, 1))\n"
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
    """Whether a process runs; one that has ended may wait for its new parent to take note."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_many_points_are_matched_as_well_by_pot_as_by_scipy(rng):
    for points, others in kinds(1024, rng).values():
        cost = torch.cdist(points, others)[0].numpy()
        want = cost[linear_sum_assignment(cost)].mean()
        assert earth_movers_distance(points, others).item() == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize("n", [30, 200])
def test_the_exact_distance_is_that_of_pot(n, rng):
    points, others = kinds(n, rng)["surface"]
    cost = torch.cdist(points, others)[0].numpy()
    want = ot.emd2(np.full(n, 1 / n), np.full(n, 1 / n), cost)
    assert earth_movers_distance(points, others).item() == pytest.approx(want, rel=1e-9)
