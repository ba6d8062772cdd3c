"""The errors that users see, and how a command ends: one line on stderr and an exit status."""

import argparse
import errno
import math
import os
import re
import select
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import NoReturn, TextIO

USER_ERROR = 2
INTERRUPTED = 130
MESSAGE = 300
"""Most characters of a parser's message."""
LISTED = 800
"""Most characters of a list of allowed names."""

CLOSED_PIPE = 141
"""128 + SIGPIPE, the status that shells report for other programs."""


class UserError(ValueError):
    """A mistake in settings, files or arguments; the command line prints it without a traceback."""


class Parser(argparse.ArgumentParser):
    """Parser of a subcommand's arguments.

    Its errors show no control characters: a shell puts names of files in the place of ``*``. A
    path may begin with ``~`` for a home folder.

    Args:
        prog: what the user typed to start the subcommand.
        description: keeps its lines.
    """

    def __init__(self, prog: str, description: str) -> None:
        kept = argparse.RawDescriptionHelpFormatter
        super().__init__(prog=prog, description=description, formatter_class=kept)
        self.register("type", Path, lambda text: Path(text).expanduser())
        self._negative_number_matcher = re.compile(r"-\.?\d")  # also the first of several numbers

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, and exit."""
        super().error(as_line(message))


class Interrupted(Exception):
    """A run was stopped by a signal.

    Not a KeyboardInterrupt: Lightning turns that into ``SystemExit(1)`` and hides what happened.
    """


def check_at_least(minimum: float, **arguments: float) -> None:
    """Reject arguments that are smaller than a minimum, infinite or not a number.

    Raises:
        UserError: it names the argument.
    """
    for name, value in arguments.items():
        if not minimum <= value < math.inf:
            raise UserError(f"{name} must be at least {minimum}, got {value}.")


def did_you_mean(name: str, allowed: Iterable[str]) -> str:
    """Suggest the allowed names closest to ``name``, and list all of them if that is short.

    Args:
        name: the unknown name.
        allowed: the allowed names.

    Returns:
        A phrase that starts with a space, to append to the first sentence of an error.
    """
    names = sorted(allowed)
    close = get_close_matches(name, names, n=3, cutoff=0.5)
    hint = ""
    if close:
        hint += f" Did you mean {' or '.join(repr(match) for match in close)}?"
    listed = ", ".join(names)
    if len(listed) <= LISTED:
        hint += f" Allowed: {listed}."
    return hint


def one_line(error: BaseException) -> str:
    """Return the type and the message of a parser's error, short and on one line."""
    message = " ".join(str(error).split())
    if len(message) > MESSAGE:
        message = f"{message[:MESSAGE]}…"
    return f"{type(error).__name__}: {message}"


def printable(text: str) -> str:
    """Return a text with its control characters escaped: names of files may hold any.

    Line ends and tabs are kept.
    """
    return "".join(map(_printable_character, text))


def _printable_character(character: str) -> str:
    if character.isprintable() or character in "\n\t":
        return character
    return character.encode("unicode_escape").decode()


def as_line(text: str) -> str:
    """Return the text of an error on one printable line, long words without their middle."""
    short = re.sub(r"(\S{200})\S{100,}(\S{100})", r"\1…\2", text)
    return printable(short.replace("\n", "\\n"))


def file_error(error: OSError) -> str:
    """Return one line about a file or folder that cannot be read or written."""
    line = f"{error.strerror or error}."
    if error.filename:
        line = f"{error.filename}: {line}"
    is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    if is_full:
        line += " Free some space, or give another folder, and run the same command again."
    return line


def line_about(error: BaseException) -> str | None:
    """Return one line about an error that the user can mend; None for a fault of the program."""
    if isinstance(error, UserError):
        return str(error)
    if isinstance(error, OSError):
        return file_error(error)
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError) or re.search(r"(can't|not enough|out of) .*memory", text):
        return f"out of memory: {text[-200:]} Try a smaller batch_size, or smaller clouds."
    if isinstance(error, RuntimeError) and "determine home directory" in text:  # Python's words
        return "a path begins with ~NAME, but no user has this name. For a file, write ./~NAME."
    return None


def end_in_one_line(name: str, error: Exception) -> NoReturn:
    """Print one line about an error that the user can mend, and exit; raise any other error.

    Raises:
        SystemExit: the user can mend it.
    """
    line = line_about(error)
    if line is None or isinstance(error, BrokenPipeError):
        raise error
    end(name, line, USER_ERROR)


def end(name: str, message: str, status: int) -> NoReturn:
    """Print ``name: message`` on stderr and exit.

    Raises:
        SystemExit: always, with ``status``.
    """
    print(as_line(f"{name}: {message}"), file=sys.stderr)
    sys.exit(status)


@contextmanager
def one_line_endings(prog: str, interrupted: str = "interrupted.") -> Iterator[None]:
    """End a subcommand in one line for mistakes, files that cannot be used, and Ctrl-C.

    Args:
        prog: what the user typed to start the subcommand.
        interrupted: the line for Ctrl-C.

    Raises:
        SystemExit: instead of these errors, and see ``quiet_on_closed_pipe``.
    """
    name = prog.removeprefix("python -m ")
    with quiet_on_closed_pipe():
        try:
            yield
        except Exception as error:
            end_in_one_line(name, error)
        except KeyboardInterrupt:
            end(name, interrupted, INTERRUPTED)


@contextmanager
def quiet_on_closed_pipe() -> Iterator[None]:
    """Exit without a traceback when the reader of the output has ended, such as ``| head``.

    Raises:
        SystemExit: with ``CLOSED_PIPE``, when stdout or stderr is a pipe without a reader.
    """
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        closed = closed_outputs()
        if not closed:
            raise  # a socket or a worker's pipe
        null = os.open(os.devnull, os.O_WRONLY)
        for stream in closed:
            os.dup2(null, stream.fileno())  # Python flushes both again at its exit
        sys.exit(CLOSED_PIPE)


def closed_outputs() -> list[TextIO]:
    """List which of stdout and stderr are pipes without a reader."""
    return [stream for stream in (sys.stdout, sys.stderr) if _is_closed_pipe(stream)]


def _is_closed_pipe(stream: TextIO) -> bool:
    try:
        poll = select.poll()
        poll.register(stream.fileno(), 0)
    except (AttributeError, OSError):  # no poll on Windows, no file behind the stream
        return False
    return any(state & (select.POLLERR | select.POLLHUP) for _, state in poll.poll(0))
