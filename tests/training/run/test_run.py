import pytest

from mops_lightning.config.compose import compose
from mops_lightning.errors import Interrupted, UserError
from mops_lightning.records import run_record
from mops_lightning.training.run.run import recorded


def test_recorded_running_then_completed(tmp_path):
    with recorded(compose(["seed=4"]), tmp_path, ["seed=4"]) as record:
        assert run_record.read(tmp_path).status == "running"
        record.metrics["test/generated/accuracy"] = 0.5
    found = run_record.read(tmp_path)
    assert (found.status, found.error, found.seed) == ("completed", None, 4)
    assert found.overrides == ["seed=4"]
    assert found.metrics == {"test/generated/accuracy": 0.5}
    assert found.seconds["total"] >= 0


@pytest.mark.parametrize(
    ("raised", "status", "error"),
    [
        (UserError("m is wrong"), "failed", "UserError: m is wrong"),
        (Interrupted("Resume it."), "interrupted", "Resume it."),
        (KeyboardInterrupt(), "interrupted", "interrupted"),
    ],
)
def test_recorded_exception_is_written_and_raised(raised, status, error, tmp_path):
    with pytest.raises(type(raised)), recorded(compose(), tmp_path, []):
        raise raised
    found = run_record.read(tmp_path)
    assert (found.status, found.error) == (status, error)
