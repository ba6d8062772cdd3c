import os
from typing import Any

import pytest

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.report.collect import collect
from tests.support.reports import put, put_cell, rows, table


def test_collect_counts_but_hides_unfinished_runs(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8}, status="interrupted")
    text = table(tmp_path)
    assert "80.00" not in text
    assert "1 of 2 runs has no full result" in text


def test_collect_lists_partial_tests_apart(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    part = ["tested on 1 of 4 batches"]
    put(tmp_path / "more", "fps", 32, {"test/sampled/accuracy": 0.9}, seed=1, partial=part)
    text = table(tmp_path)
    assert rows(text)[1] == ["fps", "30.00"]
    assert "1 of 2 runs has no full result" in text
    assert f"- {tmp_path}/more/fps-32-pointnet: completed: tested on 1 of 4 batches" in text
    with pytest.raises(UserError, match=r"none of its 1 runs has a full result: .*1 of 4 batches"):
        table(tmp_path / "more")


def test_collect_lists_failed_cells_with_reason(tmp_path):
    put_cell(tmp_path, "done", "mops", {"generated": 1.0})
    (tmp_path / "failed").mkdir()
    (tmp_path / "failed" / ".failed").write_text("m must be at most 64\n")
    put_cell(tmp_path / "done", ".attempts/1", "mops", {"generated": 9.0})
    text = table(tmp_path)
    assert "1 of 2 runs has no full result:" in text
    assert f"- {tmp_path}/failed: m must be at most 64" in text
    assert "9" not in rows(text)[1][1]


def test_collect_lists_unreadable_records(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "result.json").write_text("")
    path = put(tmp_path, "random", 32, {"test/sampled/accuracy": 0.2})
    path.write_text(path.read_text().replace('"m": 32', '"m": "x"'))
    (tmp_path / "folder" / "result.json").mkdir(parents=True)
    text = table(tmp_path)
    assert f"- {tmp_path}/bad: {tmp_path}/bad/result.json: not a run record" in text
    assert "got &#96;str&#96; - at &#96;$.m&#96;" in text
    assert "3 of 4 runs have no full result" in text


def test_collect_reads_records_of_many_runs_from_one_file(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "random", 32, {"test/sampled/accuracy": 0.2})
    before = table(tmp_path)
    run_record.write_many(tmp_path / "runs.jsonl", collect(tmp_path).done)
    assert str(tmp_path) not in (tmp_path / "runs.jsonl").read_text()
    for path in tmp_path.rglob("result.json"):
        path.unlink()
    assert table(tmp_path) == before
    with (tmp_path / "runs.jsonl").open("a") as file:
        file.write("broken\n")
    text = table(tmp_path)
    assert "1 of 3 runs has no full result" in text
    assert "line 3: not a run record" in text
    assert rows(text) == rows(before)


def test_collect_named_pipe_is_skipped(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    (tmp_path / "pipe").mkdir()
    for name in ("result.json", "runs.jsonl", ".failed"):
        os.mkfifo(tmp_path / "pipe" / name)
    assert "result.json: no run record" in table(tmp_path)


def test_collect_says_why_runs_have_no_result_and_lists_three(tmp_path):
    part = ["trained for 1 of 2 steps", "tested on 1 of 4 batches"]
    changes: dict[str, dict[str, Any]] = {
        "a": {"status": "failed", "error": "UserError: m is wrong", "partial": part},
        "b": {"status": "interrupted", "error": "Stopped."},
        "c": {"status": "running"},
        "d": {"status": "running"},
    }
    for name, of_run in changes.items():
        put(tmp_path / name, "fps", 32, {"test/sampled/accuracy": 0.3}, **of_run)
    reasons = {
        "a": "failed: trained for 1 of 2 steps and tested on 1 of 4 batches",
        "b": "interrupted: Stopped.",
        "c": "running",
    }

    with pytest.raises(UserError) as refused:
        collect(tmp_path)

    listed = [f"{tmp_path}/{name}/fps-32-pointnet ({why})" for name, why in reasons.items()]
    assert str(refused.value) == (
        f"{tmp_path}: none of its 4 runs has a full result: {'; '.join(listed)}."
    )


def test_collect_sorts_runs_by_folder(tmp_path):
    for name in ("c", "a", "b"):
        put(tmp_path / name, "fps", 32, {"test/sampled/accuracy": 0.3})

    folders = [record.folder for record in collect(tmp_path).done]

    assert folders == [f"{tmp_path}/{name}/fps-32-pointnet" for name in ("a", "b", "c")]
