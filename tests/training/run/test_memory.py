import ctypes
import sys
from types import SimpleNamespace

import pytest

from mops_lightning.training.run.memory import keep_freed_memory


@pytest.mark.parametrize(("platform", "options"), [("linux", 3), ("win32", 0)])
def test_keep_freed_memory_sets_options_of_linux(monkeypatch, platform, options):
    called = []
    library = SimpleNamespace(mallopt=lambda *option: called.append(option))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: library)
    monkeypatch.setattr(sys, "platform", platform)

    keep_freed_memory()

    assert len(called) == options
