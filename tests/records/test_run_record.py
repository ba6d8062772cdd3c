import json
import math
import platform
import shutil
import subprocess
import time
from dataclasses import replace

import pytest

from mops_lightning.errors import UserError
from mops_lightning.records import run_record
from mops_lightning.records.run_record import RunRecord
from tests.support.records import CONFIG, evaluated, record


def test_write_then_read_returns_same_record(tmp_path):
    run_record.write(tmp_path, record(evaluated=evaluated(seed=7)))
    assert run_record.read(tmp_path).metrics == {"test/generated/accuracy": 0.5}
    assert run_record.read(tmp_path).evaluated == evaluated(seed=7)
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_write_nan_becomes_null(tmp_path):
    run_record.write(tmp_path, record(metrics={"a": math.nan, "b": math.inf}))
    text = (tmp_path / "result.json").read_text()
    assert json.loads(text)["metrics"] == {"a": None, "b": None}


@pytest.mark.parametrize(
    "changes",
    [
        {"status": "done"},
        {"metrics": {"nested": {"a": 1}}},
        {"seconds": {"total": -1}},
        {"device": 3},
        {"config": {"names": "mops"}},
        {"config": {"names": {"task": "classification", "net": "pointnet", "dataset": "shapes"}}},
        {"config": {"sampler": "mops"}},
        {"config": {"baselines": {"fps": 1.5}}},
        {"config": {"dataset": {"n_points": {}}}},
        {"config": {"m": "x"}},
        {"metrics": {"a": "x"}},
        {"metrics": {"a": 10**400}},
        {"metric_info": {"accuracy": {"scale": "x"}}},
        {"evaluated": {"seed": "x"}},
    ],
)
def test_write_of_wrong_type_raises_and_writes_nothing(tmp_path, changes):
    with pytest.raises(ValueError, match=r"Expected|Invalid|missing|range"):
        run_record.write(tmp_path, record(**changes))
    assert not list(tmp_path.iterdir())


def test_read_no_record_raises(tmp_path):
    with pytest.raises(UserError, match="no run record"):
        run_record.read(tmp_path)
    (tmp_path / "result.json").write_text('{"schema": ')
    with pytest.raises(UserError, match="not a run record"):
        run_record.read(tmp_path)
    (tmp_path / "result.json").write_text(json.dumps({**record().plain(), "foreign": 3}))
    with pytest.raises(UserError, match="not a run record: unknown: foreign"):
        run_record.read(tmp_path)


def with_fact(value):
    """The text of a record that a value is put into."""
    text = json.dumps(record(dataset_facts={"files": "here"}).plain())
    return text.replace('"here"', value)


@pytest.mark.parametrize(
    "text",
    [
        '{"schema": ' + "1" * 5000 + "}",
        "[" * 2000 + "]" * 2000,
        with_fact("[" * 60 + "]" * 60),
        with_fact("1" + "0" * 400),
        '"\x1b[31m"',
        "\xff\xfe",
        "[" * 100_000,
    ],
    ids=["digits", "levels", "depth", "range", "escape", "bytes", "deep"],
)
def test_read_hostile_file_ends_in_one_printable_line(tmp_path, text):
    (tmp_path / "result.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError, match="not a run record") as error:
        run_record.read(tmp_path)
    assert str(error.value).isprintable()


def test_begun_record_is_read_as_written(tmp_path):
    started = RunRecord.begin(CONFIG, ["m=32"], seed=3)
    with started.timed("fit"):
        pass
    run_record.write(tmp_path, started)
    found = run_record.read(tmp_path)
    assert replace(found, digest=None) == started
    assert set(found.versions) == {"python", *run_record.PACKAGES}
    assert {"torch", "lightning", "mops-lightning", "torchmetrics"} <= set(run_record.PACKAGES)
    assert found.versions["python"] == platform.python_version()
    assert found.platform == f"{platform.system()} {platform.machine()}"
    assert found.started.endswith("+00:00")
    assert (found.status, found.seed) == ("running", 3)
    assert found.seconds["fit"] >= 0


def test_written_record_is_not_edited_and_each_changed_figure_is_noticed(tmp_path):
    path = run_record.write(
        tmp_path, record(metrics={"test/generated/accuracy": 0.5, "b": math.nan})
    )
    plain = json.loads(path.read_text())

    assert not run_record.read(tmp_path).is_edited
    for name, value in (
        ("metrics", {**plain["metrics"], "test/generated/accuracy": 0.6}),
        ("metrics", {"test/generated/accuracy": 0.5}),
        ("seconds", {"total": 1.5}),
        ("git", {"commit": "c" * 40, "dirty": True}),
        ("config", {**plain["config"], "m": 16}),
        ("dataset_fingerprint", "another"),
        ("digest", "0" * 64),
    ):
        path.write_text(json.dumps({**plain, name: value}))
        assert run_record.read(tmp_path).is_edited, name


def test_record_that_was_moved_or_has_no_digest_is_not_edited(tmp_path):
    path = run_record.write(tmp_path / "run", record())
    plain = json.loads(path.read_text())
    found = replace(run_record.read(tmp_path / "run"), folder=str(tmp_path / "run"))
    run_record.write_many(tmp_path / "elsewhere" / "runs.jsonl", [found])

    moved = json.loads((tmp_path / "elsewhere" / "runs.jsonl").read_text())
    assert moved["digest"] == plain["digest"]
    assert moved["folder"] == "../run"
    assert not run_record.from_plain(moved).is_edited
    whole_seconds = {**plain, "seconds": {"total": 1}}  # equal numbers, written in another way
    assert not run_record.from_plain(whole_seconds).is_edited
    without_empty_fields = {}
    for name, value in plain.items():
        if value is not False and value not in (None, {}, []):
            without_empty_fields[name] = value
    assert "lengthened" not in without_empty_fields
    assert not run_record.from_plain(without_empty_fields).is_edited
    elsewhere = {**plain, "files": {"weights": "../kept/weights.safetensors"}}
    assert not run_record.from_plain(elsewhere).is_edited
    of_earlier_version = {name: value for name, value in plain.items() if name != "digest"}
    of_earlier_version["metrics"] = {"test/generated/accuracy": 0.9}
    assert not run_record.from_plain(of_earlier_version).is_edited


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_git_state_is_the_commit_and_whether_a_file_of_it_was_changed(tmp_path, monkeypatch):
    folder = tmp_path / "src" / "mops_lightning" / "records"
    folder.mkdir(parents=True)
    code = folder / "run_record.py"
    code.write_text("first\n")
    monkeypatch.setattr(run_record, "__file__", str(code))
    assert run_record.git_state() == {"commit": None, "dirty": None}  # no checkout

    def git(*words):
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        command = ["git", "-C", str(tmp_path), *who, *words]
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)

    git("init")
    git("add", "src")
    git("commit", "--no-gpg-sign", "-m", "First")
    commit = git("rev-parse", "HEAD").stdout.strip()
    (tmp_path / "notes.md").touch()
    assert run_record.git_state() == {"commit": commit, "dirty": False}

    code.write_text("second\n")
    assert run_record.git_state() == {"commit": commit, "dirty": True}


def test_timed_records_milliseconds_also_after_an_error(monkeypatch):
    clock = iter([1.0, 2.23456, 5.0, 5.5])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    made = record()

    with made.timed("fit"):
        pass
    with pytest.raises(UserError), made.timed("test"):
        raise UserError("no")

    assert made.seconds == {"total": 1.0, "fit": 1.235, "test": 0.5}


def test_records_of_several_runs_name_folders_relative_to_their_file(tmp_path):
    found = [record(folder=str(tmp_path / "runs" / name)) for name in ("a", "b")]

    run_record.write_many(tmp_path / "kept" / "runs.jsonl", found)

    lines = (tmp_path / "kept" / "runs.jsonl").read_text().splitlines()
    assert [json.loads(line)["folder"] for line in lines] == ["../runs/a", "../runs/b"]


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_git_state_of_a_broken_checkout_is_unknown(tmp_path, monkeypatch):
    folder = tmp_path / "src" / "mops_lightning" / "records"
    folder.mkdir(parents=True)
    (tmp_path / ".git").write_text("gitdir: nowhere\n")
    monkeypatch.setattr(run_record, "__file__", str(folder / "run_record.py"))

    assert run_record.git_state() == {"commit": None, "dirty": None}
