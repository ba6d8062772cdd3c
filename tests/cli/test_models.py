import os

import pytest

from mops_lightning.cli.models import main
from mops_lightning.zoo import model_file, names, publish
from tests.support.captured import captured, done, refused
from tests.support.full_disk import full_disk
from tests.support.models import rewrite, write_run

COMMAND = "mops-lightning models"


def call(*arguments):
    return captured(main, arguments, COMMAND)


def test_models_lists_name_task_sizes_figures_licence_and_size():
    out = done(main, [], COMMAND)
    lines = {line.split()[0]: " ".join(line.split()) for line in out.splitlines()[1:]}
    assert set(lines) == set(names.available())
    assert lines["fmops.modelnet40-m512"].startswith(
        "fmops.modelnet40-m512 classification 1-512 accuracy (%), m=32: 85.41 generated, "
        "84.16 matched, 81.12 completed MIT"
    )
    assert "accuracy (%): 87.24 on all points" in lines["pointnet.modelnet40"]


@pytest.mark.parametrize("name", names.available())
def test_models_shows_the_card_of_every_model(name):
    out = done(main, [name], COMMAND)
    shown = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert shown["name"] == name
    for key in ("input", "data", "recipe", "commit", "licence", "test", "sha256"):
        assert shown[key], key


def test_models_add_publishes_a_run(tmp_path, monkeypatch):
    write_run(tmp_path / "run")
    status, _, err = call("add", tmp_path / "run", "fmops.mine")
    assert status == 2
    assert "--folder" in err
    arguments = ["add", tmp_path / "run", "fmops.mine", "--folder", tmp_path / "models"]
    out = done(main, arguments, COMMAND)
    assert "evaluate=fmops.mine also needs weights=FILE" in out
    assert f"set {names.VARIABLE}={tmp_path}/models" in out
    monkeypatch.setenv(names.VARIABLE, str(tmp_path / "models"))
    assert "fmops.mine" in call()[1]
    assert "exists" in call("add", tmp_path / "run", "fmops.mine")[2]


def test_models_add_keeps_notes_for_the_card(tmp_path, monkeypatch):
    write_run(tmp_path / "run")
    monkeypatch.setenv(names.VARIABLE, str(tmp_path / "models"))
    notes = "Give clouds with z up."

    done(main, ["add", tmp_path / "run", "fmops.mine", "--notes", notes], COMMAND)
    card = done(main, ["fmops.mine"], COMMAND)

    shown = dict(line.split(maxsplit=1) for line in card.splitlines())
    assert shown["notes"] == notes


def test_models_lists_readable_files_next_to_a_damaged_one(tmp_path, monkeypatch):
    (tmp_path / "fmops.damaged.safetensors").write_bytes(b"none")
    monkeypatch.setenv(names.VARIABLE, str(tmp_path))
    out = done(main, [], COMMAND)
    assert "pointnet.modelnet40" in out
    assert out.splitlines()[-1].startswith(f"Not listed: {tmp_path}/fmops.damaged.safetensors is")
    write_run(tmp_path / "run")
    assert call("add", tmp_path / "run", "fmops.mine")[0] == 0


def test_models_shows_a_foreign_card_escaped_and_on_its_lines(tmp_path, monkeypatch):
    write_run(tmp_path / "run")
    assert call("add", tmp_path / "run", "fmops.mine", "--folder", tmp_path)[0] == 0
    record = model_file.read_card(tmp_path / "fmops.mine.safetensors")["record"]
    record["config"] |= {"sampler": {}, "dataset": {"classes": [1]}}
    figures: dict[str, object] = {"metric": "\x1b[31m", "m": None, "points": None, "values": {}}
    odd = {"licence": "\x1b]0,title\x07 \ud800", "notes": "one\ntwo", "figures": figures}
    rewrite(tmp_path / "fmops.mine.safetensors", **odd, record=record)
    monkeypatch.setenv(names.VARIABLE, str(tmp_path))
    for arguments in ((), ("fmops.mine",)):
        out = done(main, arguments, COMMAND)
        assert "\\x1b[31m" in out
        assert "\\x1b]0,title\\x07 \\ud800" in out
    assert "one two" in out


def test_models_add_on_a_full_disk_is_one_line(tmp_path):
    write_run(tmp_path / "run")
    arguments = ["add", tmp_path / "run", "fmops.mine", "--folder", tmp_path / "new"]
    with full_disk():
        err = refused(main, arguments, COMMAND)
    assert f"{tmp_path}/new/fmops.mine.safetensors: File too large. Free some space" in err
    assert list((tmp_path / "new").iterdir()) == []


def test_models_leaves_out_a_named_pipe_and_refuses_it_by_path(tmp_path, monkeypatch):
    pipe = tmp_path / "fmops.pipe.safetensors"
    os.mkfifo(pipe)
    monkeypatch.setenv(names.VARIABLE, str(tmp_path))
    (tmp_path / "fmops.folder.safetensors").mkdir()
    assert not [name for name in ("fmops.pipe", "fmops.folder") if name in call()[1]]
    assert f"no file {pipe}" in refused(main, [pipe], COMMAND)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["pointnet.modelnet"], "Did you mean 'pointnet.modelnet40'"),
        (["add", "nowhere", "a.b", "--folder", "."], "no run record"),
    ],
)
def test_models_mistakes_are_one_line(arguments, words):
    err = refused(main, arguments, COMMAND)
    assert err.startswith("mops-lightning models: ")
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["add", "run"], "models add: error: the following arguments are required: NAME"),
        (["a.b", "c.d"], "unrecognized arguments: c.d"),
        (["pointnet.modelnet40", "--notes", "new"], "unrecognized arguments: --notes new"),
    ],
)
def test_models_arguments_of_other_uses_are_refused(arguments, words):
    status, out, err = captured(main, arguments, COMMAND)
    assert (status, out) == (2, "")
    assert words in err


def test_models_add_names_the_task_net_and_replaces_a_model_on_request(tmp_path):
    write_run(tmp_path / "run")
    arguments = ["add", tmp_path / "run", "fmops.mine", "--folder", tmp_path]
    done(main, arguments, COMMAND)

    task_net = ["--task-net", "pointnet.modelnet40", "--overwrite"]
    out = done(main, [*arguments, *task_net], COMMAND)

    files = model_file.read_card(tmp_path / "fmops.mine.safetensors")["record"]["files"]
    assert files["task_weights"].startswith("pointnet.modelnet40@sha256:")
    assert "also needs weights=FILE" not in out


def test_models_says_that_the_code_of_a_run_was_changed(tmp_path):
    git = {"commit": "0123abc", "dirty": True}
    write_run(tmp_path / "run", git=git)
    done(main, ["add", tmp_path / "run", "fmops.mine", "--folder", tmp_path], COMMAND)

    card = done(main, [tmp_path / "fmops.mine.safetensors"], COMMAND)

    shown = dict(line.split(maxsplit=1) for line in card.splitlines())
    assert shown["commit"] == "0123abc (changed)"


def test_models_shows_every_fact_of_a_card(tmp_path):
    folder = tmp_path / "run"
    git = {"commit": "0123abc", "dirty": False}
    write_run(folder, git=git, seed=7, overrides=["m=8", "sampler=fmops"])
    done(main, ["add", folder, "fmops.mine", "--folder", tmp_path], COMMAND)
    path = tmp_path / "fmops.mine.safetensors"
    size = f"{path.stat().st_size / 1e6:.2f} MB"

    out = done(main, [path], COMMAND)

    assert [line.split(maxsplit=1) for line in out.splitlines()] == [
        ["name", "fmops.mine"],
        ["net", "fmops (sampler)"],
        ["task", "classification by pointnet"],
        ["sizes", "1-16"],
        ["input", "clouds in the unit sphere (centroid at the origin, largest distance from it 1)"],
        ["test", "figures  accuracy (%), m=8: 50.00 generated"],
        ["data", "shapes, 64 points per cloud in training"],
        ["recipe", "m=8 sampler=fmops"],
        ["epochs", "3"],
        ["seed", "7"],
        ["commit", "0123abc"],
        ["licence", "MIT"],
        ["file", f"{path}, {size}"],
        ["sha256", f"{model_file.read_card(path)['sha256']} (of the tensors)"],
    ]


def test_models_shows_channels_classes_and_precision(tmp_path):
    write_run(tmp_path / "run")
    path = publish.add(tmp_path / "run", "fmops.mine", tmp_path, precision="float16")
    record = model_file.read_card(path)["record"]
    record["config"] |= {"learn": "task", "dataset": {"classes": ["chair", "vase"]}}
    channels = [["intensity", 0.0, 1.0], ["time", 0.0, 1.0]]
    rewrite(path, classes=["chair", "vase"], channels=channels, record=record)

    shown = {}
    for line in done(main, [path], COMMAND).splitlines():
        key, _, text = line.partition("  ")
        shown[key] = text.strip()

    assert shown["net"] == "pointnet (task net)"
    assert shown["channels"] == "intensity, time"
    assert shown["classes"] == "chair, vase"
    assert shown["data"] == "shapes (chair, vase)"
    assert shown["recipe"] == "m=32"
    assert shown["file"].endswith(" MB, wide layers in float16")
    assert "sizes" not in shown


def test_models_says_where_a_model_is_found(tmp_path, monkeypatch):
    write_run(tmp_path / "run")
    monkeypatch.setenv(names.VARIABLE, str(tmp_path))

    out = done(main, ["add", tmp_path / "run", "fmops.mine"], COMMAND)

    path = tmp_path / "fmops.mine.safetensors"
    sha256 = model_file.read_card(path)["sha256"]
    assert out.splitlines()[:2] == [
        f"{path}: {path.stat().st_size / 1e6:.2f} MB",
        f"Records name it fmops.mine@sha256:{sha256}.",
    ]
    assert "To find it by name" not in out
