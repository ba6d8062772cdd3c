from pathlib import Path

import pytest

from mops_lightning.errors import Parser, UserError, did_you_mean, one_line_endings, printable


def test_did_you_mean_suggests_the_closest_names():
    said = " Did you mean 'chair'? Allowed: chair, table."
    assert did_you_mean("chiar", ["chair", "table"]) == said
    assert did_you_mean("zzz", ["chair"]) == " Allowed: chair."


def test_printable_escapes_control_characters():
    assert printable("a\x1b]0;b\x07 é\n\udcff") == "a\\x1b]0;b\\x07 é\n\\udcff"


def test_parser_replaces_home():
    parser = Parser("tool", "")
    parser.add_argument("path", type=Path)
    assert parser.parse_args(["~/x"]).path == Path.home() / "x"
    with pytest.raises(RuntimeError, match="home"):
        parser.parse_args(["~nosuchuser/x"])


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (UserError("no"), "tool: no\n"),
        (RuntimeError("Could not determine home directory."), "no user has this name"),
        (MemoryError(), "tool: out of memory"),
        (FileNotFoundError(2, "No such file", "a"), "tool: a: No such file.\n"),
    ],
)
def test_one_line_endings_of_mistakes(error, said, capsys):
    with pytest.raises(SystemExit, match="2"), one_line_endings("tool"):
        raise error
    assert said in capsys.readouterr().err


def test_one_line_endings_passes_faults_of_the_program_on():
    with pytest.raises(RuntimeError, match="fault"), one_line_endings("tool"):
        raise RuntimeError("fault")
