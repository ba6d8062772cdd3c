"""How densely the code is written: ``make shape`` prints it and never fails.

The figures are meant to be read beside those of other projects: kornia has 6.6 syntax nodes per
line of code, torchmetrics 6.2, trimesh 6.0.
"""

import ast
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
LONG = 60
"""Lines that a function should not exceed."""

NOT_COUNTED = (ast.expr_context, ast.operator)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass
class Shape:
    """Counts of one file, or the sums of several."""

    lines: int = 0
    nodes: int = 0
    conditionals: int = 0
    comprehensions: int = 0
    refusals: int = 0

    def add(self, other: "Shape") -> None:
        """Add the counts of another file."""
        self.lines += other.lines
        self.nodes += other.nodes
        self.conditionals += other.conditionals
        self.comprehensions += other.comprehensions
        self.refusals += other.refusals

    @property
    def density(self) -> float:
        """Syntax nodes per line of code."""
        return self.nodes / max(self.lines, 1)

    def per_thousand(self, count: int) -> float:
        """Return a count per 1,000 lines of code."""
        return 1000 * count / max(self.lines, 1)


def shape_of(text: str) -> Shape:
    """Count the syntax nodes of a module, and its lines of code.

    Blank lines, comments, imports and docstrings are no lines of code.
    """
    tree = ast.parse(text)
    shape = Shape()
    passed_over: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom) or _is_docstring(node):
            passed_over.update(_lines_of(node))
        if not isinstance(node, NOT_COUNTED):
            shape.nodes += 1
        if isinstance(node, ast.IfExp):
            shape.conditionals += 1
        if isinstance(node, COMPREHENSIONS):
            shape.comprehensions += 1
        if isinstance(node, ast.Call) and _name_of(node.func) == "UserError":
            shape.refusals += 1
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        is_code = stripped != "" and not stripped.startswith("#")
        if is_code and number not in passed_over:
            shape.lines += 1
    return shape


def long_functions(text: str) -> Iterator[tuple[str, int]]:
    """Yield the name and the length of every function with more than ``LONG`` lines."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, FUNCTIONS):
            length = len(_lines_of(node))
            if length > LONG:
                yield node.name, length


def files_below(folder: str) -> list[Path]:
    """Return the Python files of a folder that git tracks."""
    command = ["git", "ls-files", f"{folder}/*.py"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.split()]


def _is_docstring(node: ast.AST) -> bool:
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
        return False
    return isinstance(node.value.value, str)


def _lines_of(node: ast.AST) -> range:
    return range(node.lineno, node.end_lineno + 1)  # type: ignore[attr-defined]


def _name_of(function: ast.expr) -> str:
    if isinstance(function, ast.Attribute):
        return function.attr
    return getattr(function, "id", "")


def _room(path: Path) -> str:
    """Return the folder that a file is counted with, such as ``src/mops_lightning/config``."""
    parts = path.relative_to(ROOT).parts
    depth = 3 if parts[0] == "src" else 1
    return "/".join(parts[: min(depth, len(parts) - 1)])


def main() -> None:
    """Print a table of the folders, and the places that a reader would stumble over."""
    rooms: dict[str, Shape] = {}
    totals: dict[str, Shape] = {}
    dense: list[tuple[float, str]] = []
    long: list[str] = []
    for path in [*files_below("src"), *files_below("tests")]:
        name = path.relative_to(ROOT).as_posix()
        top = name.partition("/")[0]
        text = path.read_text(encoding="utf-8")
        shape = shape_of(text)
        rooms.setdefault(_room(path), Shape()).add(shape)
        totals.setdefault(top, Shape()).add(shape)
        dense.append((shape.density, name))
        for function, length in long_functions(text):
            long.append(f"{name} {function}: {length} lines")

    print(f"{'':40}{'lines':>8}{'nodes':>8}{'x if y':>8}{'loops':>8}{'refusals':>10}")
    for name, shape in [*sorted(rooms.items()), *totals.items()]:
        conditionals = shape.per_thousand(shape.conditionals)
        comprehensions = shape.per_thousand(shape.comprehensions)
        print(
            f"{name:40}{shape.lines:8}{shape.density:8.2f}{conditionals:8.1f}"
            f"{comprehensions:8.1f}{shape.refusals:10}"
        )
    print("nodes: per line; x if y, loops: conditional expressions and comprehensions per 1,000")
    print("\nThe densest files:")
    for density, name in sorted(dense, reverse=True)[:12]:
        print(f"  {density:5.2f} {name}")
    print(f"\nFunctions with more than {LONG} lines:")
    for entry in long:
        print(f"  {entry}")


if __name__ == "__main__":
    main()
