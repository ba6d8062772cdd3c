"""The notebooks of the documentation run, and contain what running them shows."""

import json
from pathlib import Path

import pytest

from tests.support.notebooks import code_cells, run

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_to_the_kinds_of_output_it_contains(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stored = [cell["outputs"] for cell in code_cells(json.loads(path.read_text()))]
    kinds = [[one["output_type"] for one in outputs] for outputs in stored]
    assert ["display_data"] in kinds  # a picture
    made = run(path)
    assert [[one["output_type"] for one in outputs] for outputs in made] == kinds


def test_there_are_three_notebooks_below_300_kb():
    assert len(NOTEBOOKS) == 3
    assert max(path.stat().st_size for path in NOTEBOOKS) < 300_000
