"""Peak memory of large clouds (paper section "Complexity Analysis") and of files in chunks."""

import subprocess
import sys

import pytest

PEAK = """
import re
import sys
from pathlib import Path

import torch

torch.manual_seed(0)
torch.set_num_threads(1)


def status(name):
    text = Path("/proc/self/status").read_text()
    return int(re.search(name + ":[^0-9]*([0-9]+)", text)[1]) * 1024


def reset_peak():  # getrusage would include the peak of the parent process
    Path("/proc/self/clear_refs").write_text("5")
"""

LARGE = """
from mops_lightning.nets.foldingnet import MFoldingNet
from mops_lightning.ops.readout import complete, match
from mops_lightning.samplers.mops import MOPSNet

training = sys.argv[1] == "training"
sampler = MOPSNet(4096, alpha=0.2, tau_min=0.5).train(training)
reset_peak()
before = status("VmRSS")
points = torch.rand(1, 40960, 3)
with torch.set_grad_enabled(training):
    sample = sampler(points)
    if training:  # the net needs less without gradients
        net = MFoldingNet(40960, pieces=128, codeword=2048).eval().requires_grad_(False)
        built = net(sample.points)
        (built.square().mean() + sum(sample.losses.values())).backward()
        assert all(p.grad.isfinite().all() for p in sampler.parameters())
    else:
        complete(match(sample.points, points), points)
print(status("VmHWM") - before)
"""

IN_CHUNKS = """
import numpy as np

from mops_lightning.files.chunks import sample_by_chunks
from mops_lightning.files.engine import Engine
from mops_lightning.files.options import Options
from mops_lightning.samplers.mops import MOPSNet

sampler = MOPSNet(16, feature_channels=(8, 8), rho_channels=(8, 8)).eval()
options = Options(16, "weights", readout="matched", chunk=20_000)
sizes, peaks = (200_000, 4_000_000), []
for number in sizes:
    path = Path(sys.argv[1]) / f"{number}.npy"
    file = np.lib.format.open_memmap(path, "w+", np.float32, (number, 3))
    for start in range(0, number, 100_000):
        file[start : start + 100_000] = np.random.default_rng(start).random((100_000, 3))
        file.flush()
    del file
for number in sizes:
    path = Path(sys.argv[1]) / f"{number}.npy"
    reset_peak()
    sample_by_chunks(path, sampler, options, Engine())
    peaks.append(status("VmHWM"))
print(peaks[1] - peaks[0])
"""


def measured(script: str, argument: str) -> int:
    """Return the number of bytes that a script prints, run in a new process."""
    command = [sys.executable, "-c", PEAK + script, argument]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="memory is measured as Linux counts it"
)


@pytest.mark.parametrize("phase", ["training", "test"])
def test_large_cloud_fits_in_one_gigabyte(phase):
    assert 5e7 < measured(LARGE, phase) < 1e9, "less would mean that nothing was measured"


def test_memory_in_chunks_is_independent_of_file_size(tmp_path):
    # The allocator alone makes up to 10 MB of difference.
    assert measured(IN_CHUNKS, str(tmp_path)) < 20e6, "the larger file has 45 MB more"
