"""The public API."""

import doctest
import inspect
import subprocess
import sys

import pytest
import torch

import mops_lightning

NAMES = mops_lightning.__all__


def test_public_names_are_listed_and_imported_by_star():
    assert set(dir(mops_lightning)) == set(NAMES)
    star: dict[str, object] = {}
    exec("from mops_lightning import *", star)
    assert {name for name in star if not name.startswith("__")} == set(NAMES)


def test_import_leaves_heavy_libraries_alone():
    code = (
        "import sys, mops_lightning\n"
        "heavy = {'torch', 'numpy', 'scipy', 'lightning', 'hydra', 'omegaconf'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "for name in mops_lightning.__all__: getattr(mops_lightning, name)\n"
        "assert 'torch' in sys.modules\n"
        "assert not {'lightning', 'hydra', 'omegaconf'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


HELP = """
from contextlib import suppress
from mops_lightning.cli.main import main
for command in ("report --help", "downsample --help", "--help"):
    sys.argv[1:] = command.split()
    with suppress(SystemExit):
        main()
"""
CARDS = """
from mops_lightning.zoo import model_file, names
assert [model_file.read_card(path) for path in names.available().values()]
"""


MISTAKE = """
from mops_lightning.cli.main import main
sys.argv[1:] = [{argument!r}]
try:
    main()
except SystemExit as stop:
    assert stop.code == 2
assert not {{'torch', 'lightning', 'numba'}} & set(sys.modules)
"""


@pytest.mark.parametrize("argument", ["smapler=mops", "sampler.alhpa=1", "m=0", "optimizer.lr=-1"])
def test_mistake_on_the_command_line_is_named_without_torch_and_lightning(argument, tmp_path):
    command = f"import sys\n{MISTAKE.format(argument=argument)}"

    done = subprocess.run(
        [sys.executable, "-c", command], cwd=tmp_path, check=True, capture_output=True, text=True
    )

    assert done.stderr.startswith(f"mops_lightning: {argument.partition('=')[0]}")


def test_help_alone_needs_no_hydra(tmp_path):
    heavy = "{'torch', 'lightning', 'hydra', 'omegaconf'}"
    code = (
        "import sys\n"
        "from mops_lightning.cli.main import main\n"
        "sys.argv[1:] = ['--help']\n"
        "main()\n"
        f"assert not {heavy} & set(sys.modules)\n"
    )

    subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL
    )


@pytest.mark.parametrize("code", [HELP, CARDS], ids=["help", "cards"])
def test_help_and_cards_of_models_need_no_torch(code):
    command = f"import sys\n{code}assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", command], check=True, stdout=subprocess.DEVNULL)


def test_unknown_name_raises_attribute_error():
    with pytest.raises(AttributeError, match="attribute MOPSNett"):
        _ = mops_lightning.MOPSNett  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", NAMES)
def test_docstring_has_shapes_and_an_example_that_runs(name):
    torch.manual_seed(0)
    text = inspect.getdoc(getattr(mops_lightning, name)) or ""
    assert "(B, " in text
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    assert example.examples
    printed: list[str] = []
    results = doctest.DocTestRunner().run(example, out=printed.append)
    assert results.failed == 0, "".join(printed)
