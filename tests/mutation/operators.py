"""Small faults, as changes of a syntax tree."""

import ast
import copy
from collections.abc import Iterator
from typing import NamedTuple

SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.And: ast.Or, ast.Or: ast.And, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div,
    ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd, ast.BitAnd: ast.BitOr, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
"""Operators of comparisons, conditions and arithmetic."""

INVERTED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}

PAIRS = (
    ("mean", "sum"), ("max", "min"), ("amax", "amin"), ("argmax", "argmin"), ("any", "all"),
    ("cummax", "cummin"), ("maximum", "minimum"), ("cos", "sin"),
)  # fmt: skip
NAMES = dict(PAIRS) | {second: first for first, second in PAIRS}
"""Functions and methods that are taken for one another."""

REMOVED = {"detach", "square", "sqrt", "abs", "clamp", "clamp_", "round", "triu", "floor", "sort"}
"""Methods that are left out: ``x.detach()`` becomes ``x``."""

UNCHANGED = (ast.Import, ast.ImportFrom, ast.Assert, ast.Global, ast.Nonlocal, ast.Pass)


class Mutant(NamedTuple):
    """One fault.

    Attributes:
        line: in the source file.
        function: qualified name of the outermost function around it; empty outside of functions.
        change: the function, and the statement before and after; finds the mutant when lines move.
        is_value: whether it is outside of the functions' bodies: a constant or a default argument.
        tree: the changed module.
    """

    line: int
    function: str
    change: str
    is_value: bool
    tree: ast.Module


class Place(NamedTuple):
    """A node, with what is needed to replace it."""

    parent: ast.AST
    field: str
    at: int | None
    node: ast.AST
    function: str
    inside: bool
    statement: ast.stmt | None

    def put(self, node: ast.AST) -> None:
        """Replace the node."""
        if self.at is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.at] = node


def mutants(source: str) -> Iterator[Mutant]:
    """Yield every fault of a module, one at a time."""
    tree = ast.parse(source)
    for number, place in enumerate(places(tree)):
        same = ast.dump(place.node)
        for variant, node in enumerate(variants(place)):
            if ast.dump(node) == same:  # equal elements swapped
                continue
            changed = copy.deepcopy(tree)
            there = places(changed)[number]
            before = _header(there.statement)
            there.put(list(variants(there))[variant])
            ast.fix_missing_locations(changed)
            after = _header(places(changed, keep=there.statement)[0].statement)
            if there.node is there.statement:
                after = _header(getattr(there.parent, there.field)[there.at])
            line = getattr(place.node, "lineno", getattr(place.statement, "lineno", 0))
            before, after = _difference(before, after)
            change = f"{place.function}: {before}  ->  {after}"
            defines = isinstance(place.statement, ast.FunctionDef | ast.ClassDef)
            value = defines or not place.inside
            yield Mutant(line, place.function, change, value, changed)


def places(tree: ast.AST, keep: ast.stmt | None = None) -> list[Place]:
    """Return the nodes that may be changed, in order; with ``keep``, that statement alone."""
    if keep is not None:
        return [Place(tree, "", None, keep, "", False, keep)]
    found: list[Place] = []
    _collect(tree, "", None, False, found)
    return found


def _collect(
    node: ast.AST, function: str, statement: ast.stmt | None, inside: bool, found: list[Place]
) -> None:
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "bases", "type_params"):
            continue
        children = value if isinstance(value, list) else [value]
        for index, child in enumerate(children):
            if not isinstance(child, ast.AST) or _untouched(child):
                continue
            here = child if isinstance(child, ast.stmt) else statement
            place = index if isinstance(value, list) else None
            found.append(Place(node, field, place, child, function, inside, here))
            if isinstance(child, ast.Raise):
                continue  # texts of errors
            name, within = function, inside
            if isinstance(child, ast.FunctionDef | ast.ClassDef) and not inside:
                name = f"{function}.{child.name}" if function else child.name
                within = isinstance(child, ast.FunctionDef)
            _collect(child, name, here, within, found)


def _untouched(node: ast.AST) -> bool:
    """Whether a node says nothing about what is computed: imports, docstrings, types."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant)
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    literal = isinstance(node, ast.Subscript) and ast.unparse(node.value) in ("Literal", "dict")
    checks = isinstance(node, ast.keyword) and node.arg == "strict"
    return literal or checks or isinstance(node, UNCHANGED)


def _header(statement: ast.stmt | None) -> str:
    """Return a statement as source; of a block only its first line."""
    if statement is None:
        return ""
    if not isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return ast.unparse(statement).split("\n")[0]
    return next(x for x in ast.unparse(statement).split("\n") if x.startswith(("def ", "class ")))


def _difference(before: str, after: str) -> tuple[str, str]:
    """Shorten two signatures to the parameters that differ."""
    if not before.startswith("def "):
        return before, after
    pairs = zip(before.split(", "), after.split(", "), strict=False)
    first, second = zip(*(pair for pair in pairs if pair[0] != pair[1]), strict=True)
    return ", ".join(first), ", ".join(second)


def variants(place: Place) -> Iterator[ast.AST]:
    """Yield the faults that replace one node."""
    node = place.node
    if isinstance(node, ast.Compare):
        yield from _compared(node)
    elif isinstance(node, ast.BoolOp | ast.BinOp | ast.AugAssign):
        if type(node.op) in SWAPPED:
            yield _with(node, op=SWAPPED[type(node.op)]())
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield node.operand
    elif isinstance(node, ast.Constant):
        yield from _other_constant(node)
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        if not isinstance(node.test, ast.Compare | ast.UnaryOp):
            yield _with(node, test=ast.UnaryOp(ast.Not(), node.test))
    elif isinstance(node, ast.comprehension):
        yield from (_with(node, ifs=_without(node.ifs, at)) for at in range(len(node.ifs)))
    elif isinstance(node, ast.Slice):
        yield from _other_slice(node)
    elif isinstance(node, ast.Call):
        yield from _other_call(node)
    elif isinstance(node, ast.Tuple | ast.List):
        if not (isinstance(place.parent, ast.Subscript) or isinstance(node.ctx, ast.Store)):
            yield from (
                _with(node, elts=_swapped(node.elts, at)) for at in range(1, len(node.elts))
            )
    elif isinstance(node, ast.With):
        yield ast.If(ast.Constant(True), node.body, [])
    if isinstance(node, ast.Expr | ast.Raise | ast.AugAssign) or (
        isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript)
    ):
        yield ast.Pass()


def _compared(node: ast.Compare) -> Iterator[ast.AST]:
    for table in (SWAPPED, INVERTED):
        for at, op in enumerate(node.ops):
            if type(op) in table:
                yield _with(node, ops=[*node.ops[:at], table[type(op)](), *node.ops[at + 1 :]])


def _other_constant(node: ast.Constant) -> Iterator[ast.AST]:
    value = node.value
    if isinstance(value, bool):
        yield ast.Constant(not value)
    elif isinstance(value, int | float):
        yield ast.Constant(value + 1)
    elif isinstance(value, str):
        yield ast.Constant(f"XX{value}")


def _other_slice(node: ast.Slice) -> Iterator[ast.AST]:
    if node.upper is not None:
        yield _with(node, upper=ast.BinOp(node.upper, ast.Sub(), ast.Constant(1)))
    for part in ("lower", "upper", "step"):
        if getattr(node, part) is not None:
            yield _with(node, **{part: None})


def _other_call(node: ast.Call) -> Iterator[ast.AST]:
    for at, keyword in enumerate(node.keywords):
        if keyword.arg not in (None, "strict"):
            yield _with(node, keywords=_without(node.keywords, at))
    if len(node.args) > 1 and not any(isinstance(one, ast.Starred) for one in node.args[:2]):
        yield _with(node, args=_swapped(node.args, 1))
    function = node.func
    if isinstance(function, ast.Attribute):
        if function.attr in NAMES:
            yield _with(node, func=_with(function, attr=NAMES[function.attr]))
        if function.attr in REMOVED:
            yield function.value
    elif isinstance(function, ast.Name) and function.id in NAMES:
        yield _with(node, func=_with(function, id=NAMES[function.id]))


def _with(node: ast.AST, **fields: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _without(items: list, at: int) -> list:
    return items[:at] + items[at + 1 :]


def _swapped(items: list, at: int) -> list:
    return [*items[: at - 1], items[at], items[at - 1], *items[at + 1 :]]
