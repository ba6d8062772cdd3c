import subprocess
import sys

import pytest

CODE = """
import resource, sys, torch
from mops_lightning.training.malloc import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory()

def step():
    for _ in range(4):
        torch.ones(2**24).mul(2)  # 64 MiB blocks, given back after every turn

for _ in range(3):
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    command = [sys.executable, "-c", CODE, how]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="mallopt is of Linux's C libraries"
)
def test_pages_are_faulted_in_once_not_at_every_step():
    assert faults("keep") < faults("default") / 4
