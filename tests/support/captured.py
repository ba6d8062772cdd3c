"""A command's main function in this process."""

import contextlib
import io
from typing import Any


def captured(main, arguments, *more):
    """Exit status and what it printed."""
    out = io.StringIO()
    err = io.StringIO()
    status: Any = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(argument) for argument in arguments], *more)
        except SystemExit as stop:
            status = stop.code
    return status, out.getvalue(), err.getvalue()


def done(main, arguments, *more):
    """What a command that succeeds prints."""
    status, out, err = captured(main, arguments, *more)
    assert (status, err) == (0, ""), out + err
    return out


def refused(main, arguments, *more):
    """The line in which a command with a mistake ends."""
    status, out, err = captured(main, arguments, *more)
    assert (status, out, err.count("\n")) == (2, "", 1), err
    return err
