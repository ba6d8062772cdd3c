"""The examples of docs/extend.md, run as written."""

import ast
import re
import sys
from pathlib import Path

import pytest
import torch

from mops_lightning import load
from mops_lightning.records import run_record
from tests.support.command_line import TINY, call, runs

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extend.md").read_text()
EXAMPLES = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE, flags=re.S))


def class_and_imports(path):
    """Return what a reader copies from an example: its class and its imports."""
    module = ast.parse(path.read_text())
    copied = (ast.Import, ast.ImportFrom, ast.ClassDef)
    module.body = [node for node in module.body if isinstance(node, copied)]
    return ast.unparse(module)


MY_SAMPLER = class_and_imports(ROOT / "examples" / "04_own_sampler.py")
MODULES = {"my_sampler.py": MY_SAMPLER, **EXAMPLES}
COMMANDS = re.findall(r"```sh\npython -m mops_lightning (.*?)\n```", PAGE)


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_has_at_most_30_lines(name):
    assert len(EXAMPLES[name].strip().splitlines()) <= 30


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """The modules of the page, which this process imports from the test's folder."""
    for name, text in MODULES.items():
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in MODULES:
        sys.modules.pop(Path(name).stem, None)


@pytest.mark.usefixtures("modules")
@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split("=")[0])
def test_example_trains_with_a_class_from_outside(command, tmp_path):
    given = command.split()
    tiny = TINY
    if "dataset._target_" in command:
        tiny = [argument for argument in TINY if not argument.startswith("dataset.")]

    status, _, err = call([*tiny, *given], tmp_path)

    assert (status, err) == (0, "")
    (run,) = runs(tmp_path)
    record = run_record.read(run)
    assert record.status == "completed"
    for argument in given:
        name, _, value = argument.partition("=")
        assert str(setting_of(record, name)) == value


def setting_of(record, path):
    """Return the value of a setting of a run by its dotted path."""
    node = record.config
    for name in path.split("."):
        node = node[name]
    return node


@pytest.mark.usefixtures("modules")
def test_run_of_own_sampler_is_evaluated_with_its_class_only(tmp_path):
    named, setting = COMMANDS[0].split()
    status, _, err = call([*TINY, named, setting], tmp_path)
    assert (status, err) == (0, "")
    (run,) = runs(tmp_path)

    status, _, err = call([f"evaluate={run}"], tmp_path)

    assert status == 2
    assert "not accepted from a record" in err

    again = [f"evaluate={run}", named, "pictures=0", "trainer=cpu", "hydra.run.dir=again"]
    status, _, err = call(again, tmp_path)

    assert (status, err) == (0, "")
    evaluated = run_record.read(tmp_path / "again")
    trained = run_record.read(run)
    assert evaluated.score == trained.score

    own_class = sys.modules["my_sampler"].MySampler
    sampler = load(run, cls=own_class)
    sampled = sampler(torch.rand(2, 64, 3))

    assert sampled.points.shape == (2, 8, 3)
