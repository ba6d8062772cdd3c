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
    names: dict[str, Any] = {"__name__": "__main__"}
    found = []
    for number, cell in enumerate(code_cells(json.loads(path.read_text()))):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            value = _execute("".join(cell["source"]), f"{path.name}, code cell {number}", names)
        outputs: list[dict[str, Any]] = []
        if printed.getvalue():
            text = printed.getvalue().splitlines(keepends=True)
            outputs.append({"output_type": "stream", "name": "stdout", "text": text})
        if value is not None:
            data = {"text/plain": repr(value).splitlines(keepends=True)}
            result = {"output_type": "execute_result", "data": data, "metadata": {}}
            outputs.append({**result, "execution_count": number + 1})
        outputs += [_picture(plt.figure(figure)) for figure in plt.get_fignums()]
        plt.close("all")
        found.append(outputs)
    return found


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the cells with code."""
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def _execute(source: str, name: str, names: dict[str, Any]) -> Any:
    """Run a cell and return the value of its last line, if that is an expression."""
    tree = ast.parse(source)
    last = tree.body[-1]
    if source.rstrip().endswith(";") or not isinstance(last, ast.Expr):
        exec(compile(tree, name, "exec"), names)
        return None
    exec(compile(ast.Module(tree.body[:-1], []), name, "exec"), names)
    return eval(compile(ast.Expression(last.value), name, "eval"), names)


def _picture(figure: Any) -> dict[str, Any]:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=60, bbox_inches="tight")
    encoded = base64.b64encode(buffer.getvalue()).decode()
    return {"output_type": "display_data", "data": {"image/png": encoded}, "metadata": {}}


def main(paths: list[str]) -> None:
    """Run notebooks and write their outputs into them."""
    for path in [Path(path).resolve() for path in paths]:
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            outputs = run(path)
        notebook = json.loads(path.read_text())
        for number, (cell, made) in enumerate(zip(code_cells(notebook), outputs, strict=True), 1):
            cell["outputs"] = made
            cell["execution_count"] = number
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
