"""Runs notebooks; ``python -m tests.support.notebooks FILES`` renews their outputs."""

import ast
import base64
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib as mpl


def run(path: Path) -> list[list[dict[str, Any]]]:
    """Run the code cells of a notebook in the current folder.

    Returns:
        The outputs of each code cell, as the notebook format stores them.
    """
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    plt.close("all")
    notebook = json.loads(path.read_text())
    variables: dict[str, Any] = {"__name__": "__main__"}
    outputs_of_cells = []
    for number, cell in enumerate(code_cells(notebook)):
        source = "".join(cell["source"])
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            value = _execute(source, f"{path.name}, code cell {number}", variables)
        outputs: list[dict[str, Any]] = []
        if printed.getvalue():
            outputs.append(_printed_text(printed.getvalue()))
        if value is not None:
            outputs.append(_result(value, number + 1))
        for figure in plt.get_fignums():
            outputs.append(_picture(plt.figure(figure)))
        plt.close("all")
        outputs_of_cells.append(outputs)
    return outputs_of_cells


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the cells with code."""
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def _execute(source: str, name: str, variables: dict[str, Any]) -> Any:
    """Run a cell and return the value of its last line, if that is an expression."""
    tree = ast.parse(source)
    *before, last = tree.body
    is_silenced = source.rstrip().endswith(";")
    if is_silenced or not isinstance(last, ast.Expr):
        exec(compile(tree, name, "exec"), variables)
        return None
    statements = ast.Module(before, [])
    exec(compile(statements, name, "exec"), variables)
    expression = ast.Expression(last.value)
    return eval(compile(expression, name, "eval"), variables)


def _printed_text(text: str) -> dict[str, Any]:
    return {
        "output_type": "stream",
        "name": "stdout",
        "text": text.splitlines(keepends=True),
    }


def _result(value: Any, count: int) -> dict[str, Any]:
    lines = repr(value).splitlines(keepends=True)
    return {
        "output_type": "execute_result",
        "data": {"text/plain": lines},
        "metadata": {},
        "execution_count": count,
    }


def _picture(figure: Any) -> dict[str, Any]:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=60, bbox_inches="tight")
    encoded = base64.b64encode(buffer.getvalue())
    return {
        "output_type": "display_data",
        "data": {"image/png": encoded.decode()},
        "metadata": {},
    }


def main(paths: list[str]) -> None:
    """Run notebooks and write their outputs into them."""
    for name in paths:
        path = Path(name).resolve()
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            outputs_of_cells = run(path)
        notebook = json.loads(path.read_text())
        renewed = zip(code_cells(notebook), outputs_of_cells, strict=True)
        for number, (cell, outputs) in enumerate(renewed, start=1):
            cell["outputs"] = outputs
            cell["execution_count"] = number
        text = json.dumps(notebook, indent=1, ensure_ascii=False)
        path.write_text(f"{text}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
