"""Runs tests on mutants: pytest collects them once, then a fork of it takes each mutant."""

import ast
import gc
import json
import os
import signal
import sys
import tempfile
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any

import pytest

from tests.mutation.operators import Mutant

ROOT = Path(__file__).parents[2]


class Runner:
    """Pytest plugin that runs the tests on every mutant of a module, in place of once.

    Args:
        module: path below ``src/mops_lightning`` without ending.
        mutants: its faults.
        report: takes each mutant that no test notices.
    """

    def __init__(
        self, module: str, mutants: Sequence[Mutant], report: Callable[[Mutant], None]
    ) -> None:
        self.path = str(ROOT / "src" / "mops_lightning" / f"{module}.py")
        self.name = f"mops_lightning.{module.replace('/', '.')}"
        self.mutants, self.report = mutants, report
        self.calls: dict[str, set[str]] = defaultdict(set)
        self.seconds: dict[str, float] = {}

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Measure all tests, then run those that may notice it on each mutant."""
        if session.testsfailed:
            raise pytest.UsageError("the tests cannot be collected")
        self._measure(session.items)
        limit = 15 + 5 * sum(self.seconds.values())
        unchanged = Mutant(0, "", "", True, ast.parse(Path(self.path).read_text()))
        if forked(lambda: self._try(unchanged, session.items), limit) != 0:
            raise pytest.UsageError("the tests fail when nothing is changed")
        for mutant in self.mutants:
            items = self._chosen(session.items, mutant)
            if forked(partial(self._try, mutant, items), limit) == 0:
                self.report(mutant)
        return True

    def _chosen(self, items: Sequence[pytest.Item], mutant: Mutant) -> list[pytest.Item]:
        """Return the tests that call the function with the fault, quick ones first.

        A constant or a default argument may be noticed without a call, so all others follow. So
        they do where no call is seen, which may be in another process.
        """
        calling = self.calls[mutant.function]
        if calling and not mutant.is_value:
            items = [item for item in items if item.nodeid in calling]
        return sorted(items, key=lambda i: (i.nodeid not in calling, self.seconds[i.nodeid]))

    def _measure(self, items: Sequence[pytest.Item]) -> None:
        """Note how long each test takes, and which functions of the module it calls."""
        with tempfile.NamedTemporaryFile("r") as answer:
            status = forked(lambda: self._record(items, Path(answer.name)), limit=900)
            if status != 0:
                raise pytest.UsageError("the tests fail on the unchanged module")
            found = json.load(answer)
        self.seconds = found["seconds"]
        self.calls.update({name: set(tests) for name, tests in found["calls"].items()})

    def _record(self, items: Sequence[pytest.Item], answer: Path) -> int:
        calls, seconds, test = defaultdict(set), {}, ""

        def trace(frame: FrameType, event: str, argument: Any) -> None:
            if frame.f_code.co_filename == self.path:
                calls[frame.f_code.co_qualname.split(".<locals>")[0]].add(test)

        sys.settrace(trace)
        for item in items:
            test, start = item.nodeid, time.monotonic()
            if not run_tests([item]):
                return 1
            seconds[test] = time.monotonic() - start
        sys.settrace(None)
        lists = {name: sorted(tests) for name, tests in calls.items()}
        answer.write_text(json.dumps({"calls": lists, "seconds": seconds}))
        return 0

    def _try(self, mutant: Mutant, items: Sequence[pytest.Item]) -> int:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            code = compile(mutant.tree, self.path, "exec")
        replace_functions(code, self.path)
        if mutant.is_value:
            replace_values(code, sys.modules[self.name])
        return 0 if run_tests(items) else 1


def run_tests(items: Sequence[pytest.Item]) -> bool:
    """Run tests up to the first that fails; return whether all passed."""
    for item, following in zip(items, [*items[1:], None], strict=True):
        failed = item.session.testsfailed
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if item.session.testsfailed > failed:
            return False
    return True


def replace_functions(code: CodeType, path: str) -> None:
    """Give every function of a module, wherever it is referred to, the code of a changed module."""
    changed = {(one.co_qualname, one.co_firstlineno): one for one in _nested(code)}
    for function in gc.get_objects():
        # isinstance would ask lazy proxies for their class.
        if type(function) is FunctionType and function.__code__.co_filename == path:
            own = function.__code__
            other = changed.get((own.co_qualname, own.co_firstlineno))
            if other is None:
                continue
            if not other.co_freevars:  # the fault took out the call of super
                other = other.replace(co_freevars=own.co_freevars)
            function.__code__ = other


def _nested(code: CodeType) -> list[CodeType]:
    inner = [one for one in code.co_consts if isinstance(one, CodeType)]
    return [*inner, *(deeper for one in inner for deeper in _nested(one))]


def replace_values(code: CodeType, module: ModuleType) -> None:
    """Give constants, class attributes and default arguments the values of a changed module."""
    changed: dict[str, Any] = {"__name__": module.__name__, "__file__": module.__file__}
    exec(code, changed)
    for name, new in changed.items():
        old = getattr(module, name, None)
        if new is old:  # imported
            continue
        if isinstance(new, type) and isinstance(old, type):
            for attribute, value in vars(new).items():
                if isinstance(value, FunctionType):
                    _replace_defaults(vars(old).get(attribute), value)
                elif not attribute.startswith("__") and not hasattr(value, "__get__"):
                    setattr(old, attribute, value)
        elif isinstance(new, FunctionType):
            _replace_defaults(old, new)
        elif isinstance(new, int | float | str | tuple | dict) and new != old:
            for other in list(sys.modules.values()):
                if getattr(other, name, None) is old:
                    setattr(other, name, new)


def _replace_defaults(old: object, new: FunctionType) -> None:
    if isinstance(old, FunctionType):
        old.__defaults__, old.__kwdefaults__ = new.__defaults__, new.__kwdefaults__


def forked(work: Callable[[], int], limit: float) -> int:
    """Return the status of a function in a process of its own; -1 if it took too long."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setsid()
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            status = work()
        finally:
            os._exit(status)
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -1
