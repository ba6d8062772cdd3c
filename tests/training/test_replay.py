"""What ``evaluate=RUN`` takes from RUN's record, and what it refuses to take."""

import json

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError
from mops_lightning.training.replay import command_line
from tests.support.command_line import TINY
from tests.support.records import record

OVERRIDES = [*TINY, "sampler=fmops", "sampler.m_max=32"]
NAMES = {"task": "classification", "net": "pointnet", "dataset": "shapes", "sampler": "fmops"}


def write_run(folder, overrides=OVERRIDES, learn="sampler", **names):
    """Write the record of a completed run; only the record is read here."""
    folder.mkdir()
    config = {"learn": learn, "names": {**NAMES, **names}}
    content = record(overrides=overrides, config=config, files={"weights": "weights.pt"})
    (folder / "result.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run")


def overrides_after(*arguments):
    return [a for a in command_line(list(arguments)) if not a.startswith("evaluate=")]


def test_command_line_flags_before_or_after(run):
    assert overrides_after("-m", "m=4,8", f"evaluate={run}")[:2] == ["-m", "m=4,8"]
    assert overrides_after("--cfg", "job", f"evaluate={run}")[:2] == ["--cfg", "job"]
    assert overrides_after(f"evaluate={run}", "m=4", "-m")[-2:] == ["m=4", "-m"]


def test_command_line_added_setting_may_be_a_default_by_now(tmp_path):
    added = ["task=registration", "+sampler.anchors=fps", "+sampler@baselines.own=submodular"]
    names = {"task": "registration", "net": "pcrnet"}
    run = write_run(tmp_path / "run", [*OVERRIDES, *added], **names)
    repeated = overrides_after(f"evaluate={run}")
    assert "++sampler.anchors=fps" in repeated
    assert "+sampler@baselines.own=submodular" in repeated
    cfg = compose(repeated)
    assert cfg.sampler.anchors == "fps"
    assert "own" in cfg.baselines


def test_command_line_same_group_keeps_settings(run):
    plain = set(overrides_after(f"evaluate={run}"))
    named = overrides_after(f"evaluate={run}", "dataset=shapes", "sampler=fmops")
    assert set(named) == plain
    assert len(named) == len(plain)
    other = overrides_after(f"evaluate={run}", "dataset=meshes")
    assert "dataset=meshes" in other
    assert not any(a.startswith(("dataset.", "dataset=shapes")) for a in other)


def test_command_line_run_named_in_several_ways(run, tmp_path):
    first = command_line([f"evaluate={run}"])
    for name in (f"evaluate='{run}'", f"+evaluate={run}", f"evaluate={run}/"):
        assert command_line([name]) == first
    strange = tmp_path / "it's (1), a run"
    strange.symlink_to(run)
    assert compose(command_line([f"evaluate={strange}"])).evaluate == str(strange)
    with pytest.raises(UserError, match="takes one run"):
        command_line([f"evaluate={run},{run}"])


def test_command_line_missing_data_raises(tmp_path):
    run = write_run(tmp_path / "run", ["dataset=meshes", "dataset.root=meshes"], dataset="meshes")
    with pytest.raises(UserError, match=r"dataset\.root=meshes, which does not exist"):
        command_line([f"evaluate={run}"])
    assert "dataset.root=." in command_line([f"evaluate={run}", "dataset.root=."])


def test_command_line_without_evaluate_is_unchanged():
    assert command_line(["m=8", "evaluate=null"]) == ["m=8", "evaluate=null"]
    assert command_line(["--help"]) == ["--help"]


ATTACKS = {
    "target": ["sampler._target_=os.system"],
    "added target": ["+task.net.extra._target_=os.system"],
    "nested target": ["+sampler.extra={_target_: os.system}"],
    "target in list": ["+sampler.extra=[{_target_: os.system}]"],
    "interpolation": ["sampler.alpha=${oc.env:HOME}"],
    "path as choice": ["task/net=../../evil"],
    "path as experiment": ["+experiment=../evil"],
    "path in a package": ["+sampler@baselines.x=../evil"],
    "sweep": ["sampler.alpha=1,2"],
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_command_line_record_with_code_raises(attack, tmp_path):
    folder = write_run(tmp_path / "run", [*OVERRIDES, *ATTACKS[attack]])
    with pytest.raises(UserError, match="not accepted from a record") as refused:
        command_line([f"evaluate={folder}"])
    assert ATTACKS[attack][0].partition("=")[0].lstrip("+") in str(refused.value)


@pytest.mark.parametrize("nothing", ["{}", "[]", "null"])
def test_command_line_record_with_emptied_group_is_repeated(nothing, tmp_path):
    folder = write_run(tmp_path / "run", [*OVERRIDES, f"baselines={nothing}"])
    assert f"baselines={nothing}" in command_line([f"evaluate={folder}"])


@pytest.mark.parametrize(
    "override",
    [
        *("cache=/evil", "dataset.cache=/evil", "out=/evil", "++dataset.download=true"),
        *("dataset.mirrors=[http://evil]", "dataset.archive_hash=null", "hydra.run.dir=/evil"),
        *("logger=mlflow", "logger.tracking_uri=http://evil", "+logger.save_dir=/evil"),
        *("+task_nets=[hf://evil]", "weights=hf://evil", "+models.path=[/evil]"),
        *("+trainer.default_root_dir=/evil", "+callbacks.checkpoint.dirpath=/evil"),
    ],
)
def test_command_line_record_chooses_no_address_and_no_folder_to_write(override, tmp_path):
    run, other = tmp_path / "run", tmp_path / "other"
    plain = overrides_after(f"evaluate={write_run(run, OVERRIDES)}")
    assert overrides_after(f"evaluate={write_run(other, [*OVERRIDES, override])}") == plain


@pytest.mark.parametrize("group", ["task", "dataset", "sampler"])
def test_command_line_record_with_path_as_group_raises(group, tmp_path):
    folder = write_run(tmp_path / "run", [], **{group: "../../../tmp/evil"})
    with pytest.raises(UserError, match="not accepted from a record"):
        command_line([f"evaluate={folder}"])


@pytest.mark.parametrize(
    "override",
    [
        "+hydra.callbacks.x._target_=os.system",
        "hydra/launcher=joblib",
        "hydra.run.dir=/tmp/x",
        "+callbacks.x._target_=os.system",
        "+trainer.x._target_=os.system",
        "+unknown.x._target_=os.system",
    ],
)
def test_command_line_takes_no_undeclared_setting_from_record(override, tmp_path):
    folder = write_run(tmp_path / "run", [*OVERRIDES, override])
    key = override.lstrip("+").partition("=")[0]
    assert not any(key in argument for argument in command_line([f"evaluate={folder}"]))


def test_command_line_user_may_give_what_a_record_may_not(tmp_path):
    folder = write_run(tmp_path / "run", ["sampler._target_=os.system"])
    given = "sampler._target_=mops_lightning.samplers.fmops.FMOPSNet"
    assert command_line([f"evaluate={folder}", given])[-1] == given


@pytest.mark.parametrize(
    "argument",
    ["task_lr_scale=3", "trainer.max_epochs=5", "optimizer=exponential", "++optimizer.lr=1"],
)
def test_command_line_setting_without_effect_raises(run, argument):
    for more in ([], ["weights=auto"]):
        with pytest.raises(UserError, match="has no effect with evaluate"):
            command_line([f"evaluate={run}", argument, *more])


def test_command_line_sampler_for_a_task_net_alone_raises(tmp_path):
    run = write_run(tmp_path / "run", learn="task")
    for argument in ("sampler=fps", "sampler.m_max=8", "++sampler.alpha=3"):
        with pytest.raises(UserError, match=r"has no effect .* trained a task net alone\. To test"):
            command_line([argument, f"evaluate={run}"])


def test_command_line_pretraining_takes_its_settings(run):
    with pytest.raises(UserError, match=r"epochs.task=2: has no effect"):
        command_line([f"evaluate={run}", "epochs.task=2"])
    assert "epochs.task=2" in overrides_after(
        f"evaluate={run}", "epochs.task=2", "weights=auto", "trainer=cpu"
    )


def test_command_line_run_without_a_name_raises():
    with pytest.raises(UserError, match=r"^evaluate=: no run is given\. Give a run's folder or a "):
        command_line(["task=registration", "evaluate="])
    assert command_line(["evaluate=null"]) == ["evaluate=null"]
