"""4,096 of 40,960 points fit into 1 GB (paper section "Complexity Analysis"); more in chunks."""

import subprocess
import sys

import pytest

SCRIPT = """
import resource
import sys

import torch

from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.readout import complete, match
from mops_lightning.samplers.mops import MOPSNet

torch.manual_seed(0)
torch.set_num_threads(1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
training = sys.argv[1] == "training"
sampler = MOPSNet(4096, alpha=0.2, tau_min=0.5).train(training)
net = MFoldingNet(40960, pieces=128, codeword=2048).eval().requires_grad_(False)
points = torch.rand(1, 40960, 3)
with torch.set_grad_enabled(training):
    sample = sampler(points)
    built = net(sample.points)
    if training:
        (built.square().mean() + sum(sample.losses.values())).backward()
        assert all(p.grad.isfinite().all() for p in sampler.parameters())
    else:
        complete(match(sample.points, points), points)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux counts it")
@pytest.mark.parametrize("phase", ["training", "test"])
def test_large_clouds_fit_into_a_gigabyte_above_the_interpreter(phase):
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, phase], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 1e9


IN_CHUNKS = """
import re
import sys
from pathlib import Path

import numpy as np
import torch

from mops_lightning.downsample.large import by_chunks
from mops_lightning.samplers.mops import MOPSNet

torch.set_num_threads(1)
sampler = MOPSNet(16, feature_channels=(8, 8), rho_channels=(8, 8)).eval()
peaks = []
for number in (200_000, 4_000_000):
    path = Path(sys.argv[1]) / f"{number}.npy"
    file = np.lib.format.open_memmap(path, "w+", np.float32, (number, 3))
    for start in range(0, number, 100_000):
        file[start : start + 100_000] = np.random.default_rng(start).random((100_000, 3))
        file.flush()
    del file
for number in (200_000, 4_000_000):
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    by_chunks(Path(sys.argv[1]) / f"{number}.npy", sampler, 16, 20_000, "matched", False)
    status = Path("/proc/self/status").read_text()
    peaks.append(int(re.search("VmHWM:[ \\t]+([0-9]+)", status)[1]) * 1024)
print(peaks[1] - peaks[0])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured as Linux counts it")
def test_memory_does_not_grow_with_a_file_that_is_read_in_chunks(tmp_path):
    command = [sys.executable, "-c", IN_CHUNKS, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    growth = int(done.stdout)
    assert growth < 10e6, "the larger file has 45 MB more"
