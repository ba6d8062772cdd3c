"""The notebooks of the documentation run, and contain what running them shows."""

import json
from pathlib import Path

import pytest

from tests.support.notebooks import code_cells, run

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_to_the_kinds_of_output_it_contains(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    notebook = json.loads(path.read_text())
    stored = [kinds_of(cell["outputs"]) for cell in code_cells(notebook)]

    outputs_of_cells = run(path)

    shown = [kinds_of(outputs) for outputs in outputs_of_cells]
    assert shown == stored
    assert ["display_data"] in shown  # a picture


def kinds_of(outputs):
    return [output["output_type"] for output in outputs]


def test_there_are_three_notebooks_below_300_kb():
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert path.stat().st_size < 300_000
