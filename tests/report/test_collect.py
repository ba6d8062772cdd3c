from tests.support.reports import put, put_cell, rows, table


def test_collect_counts_but_hides_unfinished_runs(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.8}, status="interrupted")
    text = table(tmp_path)
    assert "80.00" not in text
    assert "1 of 2 runs is not completed" in text


def test_collect_lists_failed_cells_with_reason(tmp_path):
    put_cell(tmp_path, "done", "mops", {"generated": 1.0})
    (tmp_path / "failed").mkdir()
    (tmp_path / "failed" / ".failed").write_text("m must be at most 64\n")
    put_cell(tmp_path / "done", ".attempts/1", "mops", {"generated": 9.0})
    text = table(tmp_path)
    assert "1 of 2 runs is not completed:" in text
    assert f"- {tmp_path}/failed: m must be at most 64" in text
    assert "9" not in rows(text)[1][1]


def test_collect_lists_unreadable_record(tmp_path):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "result.json").write_text("")
    assert f"- {tmp_path}/bad: not readable" in table(tmp_path)
