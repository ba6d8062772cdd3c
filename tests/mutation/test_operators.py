import ast
from pathlib import Path

import pytest

from tests.mutation.__main__ import listed
from tests.mutation.modules import TESTS
from tests.mutation.operators import mutants

SOURCE = '''
"""A module."""
LIMIT = 3
EQUAL = 64, 64


def first(points, m=2):
    """Return some points."""
    if m < 1:
        raise ValueError(f"m must be at least 1, got {m}")
    return points[:m].mean(), {"m": m}
'''


def test_mutants_cover_operators_constants_and_calls():
    changes = {mutant.change.partition(": ")[2] for mutant in mutants(SOURCE)}
    returned = "return (points[:m].mean(), {'m': m})"
    assert changes == {
        "LIMIT = 3  ->  LIMIT = 4",
        "EQUAL = (64, 64)  ->  EQUAL = (65, 64)",
        "EQUAL = (64, 64)  ->  EQUAL = (64, 65)",
        "m=2):  ->  m=3):",
        "if m < 1:  ->  if m <= 1:",
        "if m < 1:  ->  if m >= 1:",
        "if m < 1:  ->  if m < 2:",
        "raise ValueError(f'm must be at least 1, got {m}')  ->  pass",
        f"{returned}  ->  return ({{'m': m}}, points[:m].mean())",
        f"{returned}  ->  return (points[:m].sum(), {{'m': m}})",
        f"{returned}  ->  return (points[:m - 1].mean(), {{'m': m}})",
        f"{returned}  ->  return (points[:].mean(), {{'m': m}})",
        f"{returned}  ->  return (points[:m].mean(), {{'XXm': m}})",
    }


@pytest.mark.parametrize("module", TESTS)
def test_listed_modules_and_mutants_exist(module):
    root = Path(__file__).parents[2]
    files = [root / "tests" / f"{name.partition('[')[0]}.py" for name in TESTS[module]]
    assert [file for file in files if not file.is_file()] == []
    source = (root / "src" / "mops_lightning" / f"{module}.py").read_text()
    # That the mutants themselves exist is checked by `make mutants`, for making them takes seconds.
    plain = ast.unparse(ast.parse(source))
    changed = [change.partition(": ")[2].split("  ->  ")[0] for change in listed(module)]
    assert [before for before in changed if before not in plain] == []
