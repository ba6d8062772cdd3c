"""The command behind ``python -m mops_lightning.report``."""

import argparse
from pathlib import Path

from mops_lightning.errors import USER_ERROR, UserError, end, quiet_on_closed_pipe
from mops_lightning.files import atomic_write
from mops_lightning.report.build import Report, build
from mops_lightning.report.text import latex, long_csv, markdown

PAGE = "report.html"

DESCRIPTION = """Tables, plots and a page of all run records below a folder.

Reads result.json files only. As in the paper's tables, columns are sizes, and a cell holds the
figures of generated / matched / completed sets, or one figure for samplers that choose input
points. Runs that differ in one other setting, such as noise, make columns of it; in two, as an
ablation's, a heat map for each sampler. Several seeds make means and standard deviations. Where
the paper has them too, its figures stand beside ours. A folder of task nets alone gives a table of
nets."""


def main(arguments: list[str] | None = None, prog: str = "python -m mops_lightning.report") -> None:
    """Write the tables, the plots and the page into the folder.

    Args:
        arguments: those of the command line; None: ``sys.argv``.
        prog: what the user typed to start this command.
    """
    with quiet_on_closed_pipe():
        chosen = make_parser(prog).parse_args(arguments)
        try:
            report = build(chosen.folder, chosen.metric, chosen.mixed)
            written = write(report, chosen.folder)
        except UserError as error:
            end(prog.removeprefix("python -m "), str(error), USER_ERROR)
        print(markdown(report.grids, report.remarks))
        print(f"in {chosen.folder}/ lie {', '.join(written)}")


def make_parser(prog: str) -> argparse.ArgumentParser:
    """Return the parser of this command's arguments."""
    parser = argparse.ArgumentParser(
        prog=prog,
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="a run, a sweep, or any folder above records")
    parser.add_argument(
        "--metric", nargs="+", default=[], help="names behind the readout; default: the score"
    )
    parser.add_argument(
        "--mixed",
        action="store_true",
        help="allow runs of different commits or settings in one table",
    )
    return parser


def write(report: Report, folder: Path) -> list[str]:
    """Write all files of a report into its folder; return their names."""
    from mops_lightning.report.page import page
    from mops_lightning.report.plots import plots

    layout = report.axes
    planes = layout.planes or {}
    keys = [layout.column] if layout.column != "m" else []
    keys += sorted({key for pair in planes.values() for key in pair})
    texts = {
        "table.md": markdown(report.grids, report.remarks),
        "table.tex": latex(report.grids, report.remarks),
        "table.csv": long_csv(report.found.done, report.names.get("net", ""), keys),
    }
    for name, text in texts.items():
        with atomic_write(folder / name) as temporary:
            temporary.write_text(text)
    written = list(texts)
    drawn = []
    for name, figure in plots(report).items():
        for suffix, metadata in ((".png", {}), (".svg", {"Date": None})):
            with atomic_write(folder / (name + suffix)) as temporary:
                figure.savefig(temporary, dpi=150, metadata=metadata)
            drawn.append(name + suffix)
    vectors = [folder / name for name in drawn if name.endswith(".svg")]
    with atomic_write(folder / PAGE) as temporary:
        temporary.write_text(page(report, folder, vectors))
    return [*written, PAGE, *drawn]
