import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import codegen

SOURCE = """
from mops_lightning.ops.jit import jit_cached


@jit_cached
def doubled(values):
    return 2 * values.sum()
"""


@pytest.fixture
def make_doubled(tmp_path: Path) -> Callable[[], Any]:
    """A function that imports a compiled function anew, as another process would."""
    path = tmp_path / "loops.py"
    path.write_text(SOURCE)

    def make() -> Any:
        spec = importlib.util.spec_from_file_location("loops", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.doubled

    return make


def test_jit_cached_second_import_loads_the_compiled_form(make_doubled):
    make_doubled()(np.array([1.0, 2.0]))
    doubled = make_doubled()

    result = doubled(np.array([1.0, 2.0]))

    assert result == 6.0
    assert sum(doubled.stats.cache_hits.values()) == 1


def test_jit_cached_compiled_form_missing_when_saved_returns_the_result(make_doubled, monkeypatch):
    def fail(library: Any) -> None:
        raise RuntimeError(f"no compiled object yet for {library}")

    monkeypatch.setattr(codegen.CPUCodeLibrary, "_get_compiled_object", fail)

    assert make_doubled()(np.array([1.0, 2.0])) == 6.0

    monkeypatch.undo()
    assert make_doubled()(np.array([1.0, 2.0])) == 6.0


def test_jit_cached_folder_replaced_by_a_file_returns_the_result(make_doubled, tmp_path):
    doubled = make_doubled()
    cache = Path(doubled.stats.cache_path)
    for path in cache.iterdir():
        path.unlink()
    cache.rmdir()
    cache.write_text("in the way")

    assert doubled(np.array([1.0, 2.0])) == 6.0


def test_jit_cached_empty_file_of_a_compiled_form_returns_the_result(make_doubled):
    doubled = make_doubled()
    doubled(np.array([1.0, 2.0]))
    cache = Path(doubled.stats.cache_path)
    for path in cache.glob("*.nbc"):
        path.write_bytes(b"")

    assert make_doubled()(np.array([1.0, 2.0])) == 6.0
