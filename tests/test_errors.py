import errno
import math
from pathlib import Path

import pytest

from mops_lightning.errors import (
    Parser,
    UserError,
    as_line,
    check_at_least,
    did_you_mean,
    file_error,
    line_about,
    one_line,
    one_line_endings,
    printable,
)


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


def test_did_you_mean_lists_up_to_800_characters_and_suggests_three():
    names = [f"name{number:03}" for number in range(90)]

    few = did_you_mean("name0", names[:89])
    many = did_you_mean("name0", names)

    listed = ", ".join(names[:89])
    assert len(listed) == 799
    assert few.endswith(f" Allowed: {listed}.")
    assert "Allowed" not in many
    assert many.count(" or ") == 2


def test_one_line_has_the_type_and_three_hundred_characters():
    assert one_line(ValueError("a\n  b")) == "ValueError: a b"
    assert one_line(ValueError("x" * 300)) == f"ValueError: {'x' * 300}"
    assert one_line(ValueError("x" * 301)) == f"ValueError: {'x' * 300}…"


def test_as_line_shows_ends_of_lines_and_of_long_words():
    assert as_line("a\nb\x1b") == "a\\nb\\x1b"
    long = "a" * 200 + "b" * 100 + "c" * 100
    assert as_line(f"x {long} y") == f"x {'a' * 200}…{'c' * 100} y"
    assert as_line("a" * 399) == "a" * 399


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_full_disk_says_what_to_do(number):
    said = file_error(OSError(number, "No space", "a.ply"))

    assert said == (
        "a.ply: No space. Free some space, or give another folder, and run the same command again."
    )
    assert file_error(OSError(errno.EACCES, "Denied")) == "Denied."


@pytest.mark.parametrize("value", [-0.001, math.inf, math.nan])
def test_check_at_least_refuses_smaller_and_infinite_numbers(value):
    check_at_least(0, alpha=0, beta=1e300)
    with pytest.raises(UserError, match=f"beta must be at least 0, got {value}"):
        check_at_least(0, alpha=1, beta=value)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (UserError("no"), "no"),
        (RuntimeError("CUDA out of memory. Tried"), "out of memory: CUDA out of memory. Tried"),
        (RuntimeError("[enforce fail] not enough memory"), "out of memory: [enforce fail] not"),
        (RuntimeError("can't allocate memory"), "out of memory: can't allocate memory"),
        (ValueError("no"), None),
    ],
)
def test_line_about_is_for_errors_that_a_user_can_mend(error, line):
    said = line_about(error)

    if line is None:
        assert said is None
    else:
        assert str(said).startswith(line)


def test_one_line_endings_of_ctrl_c_have_a_status_of_their_own(capsys):
    with pytest.raises(SystemExit, match="130"), one_line_endings("python -m tool", "stopped."):
        raise KeyboardInterrupt

    assert capsys.readouterr().err == "tool: stopped.\n"


def test_parser_takes_negative_numbers_as_values_and_shows_no_control_characters(capsys):
    parser = Parser("tool", "first\n  second")
    parser.add_argument("--bounds", nargs=2, type=float)

    assert parser.parse_args(["--bounds", "-.5", "-1"]).bounds == [-0.5, -1.0]
    assert "first\n  second" in parser.format_help()
    with pytest.raises(SystemExit):
        parser.parse_args(["\x1b[31m"])
    assert "\\x1b[31m" in capsys.readouterr().err
