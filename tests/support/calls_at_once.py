"""Many calls of ``downsample``, one after another or at once; also as a program.

``python -m tests.support.calls_at_once THREADS CALLS`` prints the digest of all results.
"""

import hashlib
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import torch

from mops_lightning import downsample

METHODS = ("mops.modelnet40-m32", "fps", "snet.modelnet40-m32", "fmops.modelnet40-m512", "serial")


def digest(threads: int, calls: int) -> str:
    """Return the digest of the results of all calls; the first calls of all threads meet."""
    all_ready = threading.Barrier(threads)

    def call(number: int) -> tuple[torch.Tensor, torch.Tensor]:
        if number < threads:
            all_ready.wait()
        rng = torch.Generator().manual_seed(number)
        cloud = torch.rand(200, 3, generator=rng)
        method = METHODS[number % len(METHODS)]
        points, rows = downsample(cloud, 32, method)
        assert rows is not None
        return points, rows

    before = torch.get_rng_state()
    with ThreadPoolExecutor(threads) as pool:
        results = list(pool.map(call, range(calls)))
    assert torch.equal(torch.get_rng_state(), before)
    hashed = hashlib.sha256()
    for points, rows in results:
        hashed.update(points.numpy().tobytes())
        hashed.update(rows.numpy().tobytes())
    return hashed.hexdigest()


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(digest(int(sys.argv[1]), int(sys.argv[2])))
