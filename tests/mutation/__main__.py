"""``python -m tests.mutation [MODULE ...]``: the mutants of these modules that no test notices."""

import argparse
import random
import sys
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.mutation.modules import TESTS
from tests.mutation.operators import Mutant, mutants
from tests.mutation.runner import Runner

EQUIVALENT = Path(__file__).with_name("equivalent.toml")
"""The mutants that change nothing, by module and reason."""


def listed(module: str) -> set[str]:
    """Return the changes of a module that ``equivalent.toml`` gives a reason for."""
    reasons = tomllib.loads(EQUIVALENT.read_text()).get(module, [])
    return {change for reason in reasons for change in reason["changes"]}


def survivors(module: str, chosen: Sequence[Mutant]) -> int:
    """Print the mutants of a module that no test notices, and return their number."""
    found = 0

    def report(mutant: Mutant) -> None:
        nonlocal found
        found += 1
        print(f"  {module}.py:{mutant.line} {mutant.change}", flush=True)

    tests = [name.rstrip("]").partition("[") for name in TESTS[module]]
    files = [f"tests/{file}.py" for file, _, _ in tests]
    parts = [f"(not {Path(file).name} or {word})" for file, _, word in tests if word]
    # Pytest's plugins are imported already when the second module begins.
    options = [
        "-q",
        "-s",
        "-p",
        "no:cacheprovider",
        "-W",
        "ignore::pytest.PytestAssertRewriteWarning",
        *(["-k", " and ".join(parts)] if parts else []),
    ]
    if status := pytest.main([*options, *files], plugins=[Runner(module, chosen, report)]):
        raise SystemExit(f"{module}: pytest ended with {status}.")
    return found


def main(modules: Sequence[str], sample: int) -> int:
    """Print each survivor and one line per module; return 1 if one is not listed."""
    left = 0
    for module in modules or TESTS:
        start = time.monotonic()
        known = listed(module)
        made = list(mutants(Path(f"src/mops_lightning/{module}.py").read_text()))
        if unknown := known - {mutant.change for mutant in made}:
            raise SystemExit(f"{EQUIVALENT.name}: {module} has no {min(unknown)!r}.")
        chosen = [mutant for mutant in made if mutant.change not in known]
        if len(chosen) > sample:
            chosen = random.Random(0).sample(chosen, sample)
        found = survivors(module, chosen)
        noticed = len(chosen) - found
        print(
            f"{module}: {noticed} of {len(chosen)} noticed ({noticed / max(len(chosen), 1):.0%}), "
            f"{len(made)} in all, {len(known)} listed, {time.monotonic() - start:.0f} s",
            flush=True,
        )
        left += found
    return int(left > 0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("modules", nargs="*", metavar="MODULE", help="such as samplers/mops")
    parser.add_argument("--sample", type=int, default=10**6, help="a random part of each module")
    arguments = parser.parse_args()
    sys.exit(main(arguments.modules, arguments.sample))
