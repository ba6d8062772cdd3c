import json
import math

import jsonschema
import pytest

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from tests.support.records import record


def test_round_trip(tmp_path):
    run_record.write(tmp_path, record())
    assert run_record.read(tmp_path)["metrics"] == {"test/generated/accuracy": 0.5}
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_numbers_that_are_not_finite_become_null(tmp_path):
    run_record.write(tmp_path, record(metrics={"a": math.nan, "b": math.inf}))
    text = (tmp_path / "result.json").read_text()
    assert json.loads(text)["metrics"] == {"a": None, "b": None}


@pytest.mark.parametrize(
    "changes",
    [
        {"status": "done"},
        {"metrics": {"nested": {"a": 1}}},
        {"seconds": {"total": -1}},
        {"surprise": 1},
        {"device": 3},
    ],
)
def test_records_that_break_the_schema_are_not_written(tmp_path, changes):
    with pytest.raises(jsonschema.ValidationError):
        run_record.write(tmp_path, record(**changes))
    assert not list(tmp_path.iterdir())


def test_what_is_no_record_is_refused(tmp_path):
    with pytest.raises(UserError, match="no run record"):
        run_record.read(tmp_path)
    (tmp_path / "result.json").write_text('{"schema": ')
    with pytest.raises(UserError, match="not a run record"):
        run_record.read(tmp_path)
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(UserError, match="not a run record"):
        run_record.read(tmp_path)


def test_environment_names_versions():
    found = run_record.environment()
    assert {"python", "torch", "lightning", "mops-lightning"} <= set(found["versions"])
