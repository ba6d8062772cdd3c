"""4,096 of 40,960 points fit into 1 GB (paper section "Complexity Analysis")."""

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
