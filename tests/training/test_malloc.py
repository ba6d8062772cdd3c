import sys

import pytest

from mops_lightning.training.malloc import keep_freed_memory


@pytest.mark.skipif(sys.platform != "linux", reason="mallopt is a function of Linux's C libraries")
def test_keep_freed_memory_on_linux_is_accepted():
    assert keep_freed_memory()


def test_keep_freed_memory_elsewhere_does_nothing(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    assert not keep_freed_memory()
