"""Many calls at once in fresh processes, where the first calls of all threads meet."""

import os
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from mops_lightning import MOPSNet, Sampler, SNet, downsample, load
from mops_lightning.zoo import weights
from tests.support.calls_at_once import digest

MODELS = ("mops.modelnet40-m32", "snet.modelnet40-m32")

ROOT = Path(__file__).parents[2]


@pytest.fixture
def one_thread():
    """Let torch use one thread, as each process that the test starts does."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def digest_of_a_process(source: Path) -> str:
    """Return the digest of 200 calls by 20 threads of a new process."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(source)}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-W", "error", "-m", "tests.support.calls_at_once", "20", "200"]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


COMPILED_AT_ONCE = ("kernels.nearest", "kernel_order.morton_codes")
"""Loops that both processes compile: those of most calls, in a few seconds."""


def test_downsample_200_calls_in_threads_of_two_processes_equal_serial_calls(tmp_path, one_thread):
    serial = digest(1, 200)
    source = tmp_path / "src"
    forms = shutil.ignore_patterns(*[f"{loop}-*" for loop in COMPILED_AT_ONCE])
    shutil.copytree(ROOT / "src", source, ignore=forms)

    with ThreadPoolExecutor(2) as pool:
        at_once = list(pool.map(digest_of_a_process, [source, source]))

    assert at_once == [serial] * 2
    kept = list(source.rglob("kernels.nearest-*.nbc"))
    assert kept, "no process has compiled and kept this loop"


def build_own_net(_: int) -> int:
    net = torch.nn.Sequential(*[torch.nn.Linear(4, 4) for _ in range(60)])
    return len(list(net.parameters()))


def test_load_in_threads_leaves_nets_of_other_threads_alone():
    with ThreadPoolExecutor(8) as pool:
        loads = [pool.submit(load, MODELS[i % 2]) for i in range(8)]
        sizes = list(pool.map(build_own_net, range(20)))

    assert sizes == [120] * 20
    assert [type(load.result()) for load in loads] == [MOPSNet, SNet] * 4


def test_load_while_another_thread_draws_repeats_no_random_number():
    drawn = []
    loaded = threading.Event()

    def draw() -> None:
        while not loaded.is_set():
            drawn.append(float(torch.rand((), dtype=torch.float64)))

    with ThreadPoolExecutor(1) as pool:
        pool.submit(draw)
        try:
            for name in MODELS * 3:
                load(name)
        finally:
            loaded.set()  # or the pool would wait for ever

    assert len(drawn) > 10
    assert len(set(drawn)) == len(drawn)


class Noisy(Sampler):
    """A sampler from outside the package with random numbers that no weights file holds."""

    noise: torch.Tensor

    def __init__(self, m: int) -> None:
        super().__init__(m)
        self.scale = torch.nn.Parameter(torch.empty(3).uniform_())
        self.register_buffer("noise", torch.randn(3), persistent=False)


def test_load_own_class_leaves_the_random_state_and_keeps_its_buffers(tmp_path):
    path = tmp_path / weights.FILE
    own = Noisy(4)
    weights.save(path, own, {"learn": "sampler", "sampler": {"_target_": "own", "m": 4}}, {})
    before = torch.get_rng_state()

    sampler = load(path, cls=Noisy)

    assert torch.equal(torch.get_rng_state(), before)
    assert isinstance(sampler, Noisy)
    assert torch.equal(sampler.scale, own.scale)
    assert sampler.noise.isfinite().all()


def test_downsample_600_calls_need_no_more_memory():
    cloud = torch.rand(200, 3)
    for _ in range(100):
        downsample(cloud, 32, "mops.modelnet40-m32")
    before = resident()

    for _ in range(600):
        downsample(cloud, 32, "mops.modelnet40-m32")

    assert resident() - before < 2_000_000


def resident() -> int:
    """Return the memory of this process in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE")


def test_farthest_points_of_an_array_need_no_torch():
    code = (
        "import sys, numpy as np; from mops_lightning import downsample; "
        "downsample(np.eye(3), 2); assert 'torch' not in sys.modules"
    )

    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
