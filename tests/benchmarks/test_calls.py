import json
from importlib import import_module
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def calls(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return import_module("calls")


def test_table_has_a_line_for_a_case_and_a_column_for_a_call(calls):
    case = {"method": "fps", "clouds": 32, "N": 1024, "m": 512}
    other = {"method": "voxel", "clouds": 1, "N": 100_000, "m": 1000}
    record = {
        "cases": [
            case | {"call": "downsample", "seconds": 0.0102},
            case | {"call": "fpsample", "seconds": 0.0221},
            other | {"call": "downsample", "seconds": 0.01875},
        ]
    }

    table = calls.table(record)

    assert table.splitlines() == [
        "| method | points | downsample | fpsample |",
        "|---|---|--:|--:|",
        "| fps | 32 x 1,024 → 512 | 10.2 | 22.1 |",
        "| voxel | 100,000 → 1,000 | 18.8 |  |",
    ]


def test_readme_shows_table_of_the_record(calls):
    record = json.loads((BENCHMARKS / "results/cpu_calls.json").read_text())
    text = (BENCHMARKS / "README.md").read_text()

    assert calls.readme_with(text, record) == text
    assert calls.table(record) in text
