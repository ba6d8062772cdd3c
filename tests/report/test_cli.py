import csv

import pytest

from mops_lightning.filesystem import TEMPORARY
from mops_lightning.metrics.base import collection
from mops_lightning.metrics.classification import Accuracy
from mops_lightning.records import run_record
from mops_lightning.report.cli import main
from mops_lightning.tasks.classification import Classification
from tests.support.command_line import TINY, done, runs
from tests.support.records import evaluated
from tests.support.reports import put, put_planes, rows


class Doubt(Accuracy):
    """Fraction of wrong answers, per mille."""

    name = "doubt"
    label = "wrong answers"
    unit = "‰"
    scale = 1000.0
    higher_is_better = False
    summary_order = 0

    def compute(self):
        return 1 - super().compute()


class DoubtfulClassification(Classification):
    score = Doubt.name

    def metrics(self, training=False):
        return collection(Doubt(self.num_classes), Accuracy(self.num_classes))


def test_user_metric_appears_in_closing_table_and_report(tmp_path, capsys):
    """Its class declares unit and label; nothing else names it."""
    target = "task._target_=tests.report.test_cli.DoubtfulClassification"
    arguments = [*TINY, "task=classification", target, "sampler=fps", "weights=null"]

    out = done(arguments, tmp_path)

    (head,) = [line for line in out.splitlines() if "sampled by" in line]
    assert "wrong answers (‰)" in head
    assert head.index("wrong answers") < head.index("accuracy (%)")

    (run,) = runs(tmp_path)
    main([str(run)])

    text = capsys.readouterr().out
    assert text.startswith("Test wrong answers (‰): classification")
    share = run_record.read(run).metrics["test/sampled/doubt"]
    per_mille = f"{1000 * share:.2f}"
    # The checkout that this test runs in may have changes.
    unmarked = text.replace(" †", "")
    assert ["fps", per_mille] in rows(unmarked)


def test_report_of_folder_without_records_names_it(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path)])
    assert stop.value.code == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_report_of_names_that_are_no_text_is_written_and_printed(tmp_path, capsys):
    odd = {"device": "\ud800", "recipe": {"name": ["fast"]}}
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3}, **odd)

    main([str(tmp_path)])

    assert (tmp_path / "table.md").read_text() in capsys.readouterr().out
    assert "\\ud800" in (tmp_path / "table.csv").read_text()
    assert "\\ud800" in (tmp_path / "report.html").read_text()


def test_report_writes_all_files(tmp_path, capsys):
    put_planes(tmp_path)

    main([str(tmp_path)])

    printed = capsys.readouterr().out
    assert (tmp_path / "table.md").read_text() in printed
    assert "nre_cd_planes.png" in printed
    assert (tmp_path / "nre_cd_planes.png").read_bytes()[:4] == b"\x89PNG"
    svg = (tmp_path / "nre_cd_planes.svg").read_text()
    assert "samplenet" in svg or "<path" in svg
    tex = (tmp_path / "table.tex").read_text()
    assert r"1 & 1.5 / 2 & 1.9 / 2 \\" in tex
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 2
    with (tmp_path / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 20
    cell = {"sampler.alpha": "1.0", "sampler.tau": "0.9", "readout": "generated"}
    (line,) = [line for line in lines if cell.items() <= line.items()]
    assert line["sampler"] == "mops"
    assert line["metric"] == "nre_cd"
    assert line["value"] == "1.9"
    assert line["m"] == "32"


def refused(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main([str(one) for one in arguments])
    assert stop.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("content", [b"\x93weights\xff", b"a list\n", b'{"a": 1}\n', b""])
def test_records_file_that_holds_something_else_is_kept(tmp_path, capsys, content):
    put(tmp_path / "runs", "fps", 32, {"test/sampled/accuracy": 0.3})
    file = tmp_path / "weights.safetensors"
    file.write_bytes(content)

    error = refused([tmp_path / "runs", "--records", file], capsys)

    assert f"{file} exists and is not a file of run records" in error
    assert file.read_bytes() == content
    assert not (tmp_path / "runs" / "table.md").exists()


def test_records_file_of_an_earlier_report_is_replaced(tmp_path, capsys):
    file = tmp_path / "runs.jsonl"
    folder = tmp_path / "runs"
    for number in (1, 2):
        put(folder / f"{number}", "fps", number, {"test/sampled/accuracy": 0.3})

        main([str(folder), "--records", str(file)])

        lines = file.read_text().splitlines()
        assert len(lines) == number


@pytest.mark.parametrize("name", ["table.md", "table.tex", "table.csv", "report.html"])
def test_file_that_no_report_wrote_is_kept(tmp_path, capsys, name):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    (tmp_path / name).write_text("Test of mine: my own notes")

    error = refused([tmp_path], capsys)

    assert f"{tmp_path / name}: was not written by report" in error
    assert (tmp_path / name).read_text() == "Test of mine: my own notes"
    assert len(list(tmp_path.iterdir())) == 2


def test_picture_that_no_report_wrote_is_kept(tmp_path, capsys):
    for m in (8, 32):
        put(tmp_path, "fps", m, {"test/sampled/accuracy": 0.3})
    picture = tmp_path / "accuracy_curves.png"
    picture.write_bytes(b"mine")

    assert f"{picture}: was not written by report" in refused([tmp_path], capsys)
    assert picture.read_bytes() == b"mine"


def test_files_of_an_earlier_report_are_replaced(tmp_path, capsys):
    for m in (8, 32):
        put(tmp_path, "fps", m, {"test/sampled/accuracy": 0.3})
    main([str(tmp_path)])
    put(tmp_path, "mops", 32, {"test/generated/accuracy": 0.4})
    picture = tmp_path / "accuracy_curves.png"
    before = picture.read_bytes()

    main([str(tmp_path)])

    for name in ("table.md", "table.tex", "table.csv", "report.html"):
        assert "mops" in (tmp_path / name).read_text()
    assert picture.read_bytes() != before
    picture.write_bytes(before.replace(b"mops_lightning report", b"of an earlier version"))
    main([str(tmp_path)])  # its table shows whose it is


def test_edited_record_is_named(tmp_path, capsys):
    path = put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    main([str(tmp_path)])
    assert "edited after" not in capsys.readouterr().out

    path.write_text(path.read_text().replace("0.3", "0.8"))
    main([str(tmp_path)])

    assert f"- {path.parent}: the record was edited after the run" in capsys.readouterr().out


def test_csv_has_every_figure_of_every_run(tmp_path):
    learned = {
        "test/m8/generated/accuracy": 0.5,
        "test/m8/fps/accuracy": 0.25,
        "test/m8/generated/ratio": None,
        "test/full/accuracy": 0.9,
        "test/loss/cross_entropy": 1.0,
    }
    seconds = {"fit": 10.0, "total": 12.0}
    put(tmp_path / "a", "fmops", 32, learned, seed=3, seconds=seconds, device="NVIDIA H100")
    joint = {"evaluated": evaluated(seed=5, learn="joint"), "task_weights_sha256": "v"}
    put(tmp_path / "b", "mops", 8, {"test/generated/accuracy": 0.125}, **joint)
    put(tmp_path / "c", "fps", 16, {"test/sampled/accuracy": 0.1}, net="icp", threads=1)

    main([str(tmp_path)])

    commit = "0123456789" * 4
    first = f"{tmp_path}/a/fmops-32-pointnet,fmops,sampler alone,3,3"
    of_first = f"pointnet w,{commit},NVIDIA H100"
    assert (tmp_path / "table.csv").read_text().splitlines() == [
        "folder,sampler,learn,seed,epochs,m,readout,metric,value,net,commit,device",
        f"{first},8,generated,accuracy,0.5,{of_first}",
        f"{first},8,fps,accuracy,0.25,{of_first}",
        f"{first},32,full,accuracy,0.9,{of_first}",
        f"{tmp_path}/b/mops-8-pointnet,mops,joint,5,9,8,generated,accuracy,0.125,"
        f"pointnet v,{commit},cpu",
        f"{tmp_path}/c/fps-16-icp,icp on fps,sampler alone,0,0,16,sampled,accuracy,0.1,"
        f"icp,{commit},cpu",
    ]


def test_report_joins_groups_and_shows_other_metrics_on_request(tmp_path, capsys):
    for name, commit in (("a", "a" * 40), ("b", "b" * 40)):
        scores = {"test/sampled/accuracy": 0.3, "test/sampled/ratio": 2.0}
        put(tmp_path / name, name, 32, scores, git={"commit": commit, "dirty": False})

    main([str(tmp_path), "--mixed", "--metric", "ratio"])

    text = capsys.readouterr().out
    assert rows(text) == [["sampled by", "m=32"], ["a", "2"], ["b", "2"]]


def test_report_removes_what_a_killed_report_left(tmp_path, capsys):
    put(tmp_path, "fps", 32, {"test/sampled/accuracy": 0.3})
    left = tmp_path / f"{TEMPORARY}table-x.md"
    left.write_text("half")
    of_a_run = tmp_path / "fps-32-pointnet" / f"{TEMPORARY}last-x.ckpt"
    of_a_run.write_text("half")

    main([str(tmp_path)])

    assert not left.exists()
    assert of_a_run.exists()  # its run may be writing it
