"""The command ``mops-lightning report``."""

from pathlib import Path

from mops_lightning.errors import Parser, one_line_endings
from mops_lightning.filesystem import atomic_write, remove_temporary
from mops_lightning.records import run_record
from mops_lightning.report.build import Report, build_report
from mops_lightning.report.long_form import NOT_IN_CSV, long_form
from mops_lightning.report.ownership import MARK, check_records_file, check_replaceable
from mops_lightning.report.rows import RowNames
from mops_lightning.report.text import latex, markdown

TABLE = "table.md"
PAGE = "report.html"

ESCAPED = "backslashreplace"
"""How files show the bytes of names that are no text, which Python reads as lone surrogates."""

DESCRIPTION = """Write tables, plots and an HTML page of all run records below a folder.

Reads result.json and runs.jsonl files only. As in the paper's tables, columns are sizes, and a cell
has the values of generated / matched / completed sets, or one value for samplers that choose input
points. If the runs differ in one other setting, such as noise, columns are its values; if in two,
as in an ablation, each sampler gets a heat map. Several seeds give means and standard deviations.
The paper's values are shown next to ours. A folder of task nets only gives a table of nets."""


def main(arguments: list[str] | None = None, prog: str = "mops-lightning report") -> None:
    """Write the tables, the plots and the page into the folder.

    Args:
        arguments: of the command line; None: ``sys.argv``.
        prog: what the user typed to start this command.
    """
    with one_line_endings(prog):
        parser = Parser(prog, DESCRIPTION)
        add = parser.add_argument
        add("folder", type=Path, help="folder of a run, of a sweep, or of several")
        add("--metric", nargs="+", default=[], help="names of metrics; default: the task's score")
        mixed = "allow runs of different commits or settings in one table"
        add("--mixed", action="store_true", help=mixed)
        records = "also write all records to one file (.jsonl)"
        add("--records", type=Path, metavar="FILE", help=records)
        chosen = parser.parse_args(arguments)
        if chosen.records:
            check_records_file(chosen.records)
        report = build_report(chosen.folder, chosen.metric, chosen.mixed)
        written = write(report, chosen.folder)
        if chosen.records:
            run_record.write_many(chosen.records, report.found.done)
        print(markdown(report.grids, report.remarks))
        files = ", ".join(written)
        print(f"files in {chosen.folder}/: {files}")


def write(report: Report, folder: Path) -> list[str]:
    """Write all files of a report into its folder and return their names.

    Raises:
        UserError: the folder has a file of such a name that no report has written.
    """
    from mops_lightning.report.page import page
    from mops_lightning.report.plots import plots
    from mops_lightning.viz.figures import save_figure

    figures = plots(report)
    pictures = []
    for name in figures:
        pictures += [f"{name}.png", f"{name}.svg"]
    names = [TABLE, "table.tex", "table.csv", PAGE, *pictures]
    check_replaceable(folder, names)
    remove_temporary(folder, below=False)
    texts = {
        TABLE: markdown(report.grids, report.remarks),
        "table.tex": latex(report.grids, report.remarks),
        "table.csv": _csv(report),
    }
    for name, text in texts.items():
        _write_text(folder / name, text)
    for name, figure in figures.items():
        for suffix in (".png", ".svg"):
            path = folder / f"{name}{suffix}"
            save_figure(figure, path, dpi=150, software=MARK)
    drawn = [folder / f"{name}.svg" for name in figures]
    _write_text(folder / PAGE, page(report, folder, drawn))
    return names


def _csv(report: Report) -> str:
    """Return every figure of every run as comma-separated values."""
    settings: set[str] = set()
    for table in report.tables:
        settings.update(table.group.settings)
    net = ""
    if report.tables:
        net = report.tables[0].net
    found = report.found.done
    rows = RowNames(found, net, sorted(settings))
    long = long_form(found, rows, sorted(settings))
    shown = long.drop(columns=[*NOT_IN_CSV])
    return shown.to_csv(index=False, lineterminator="\n")


def _write_text(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text, errors=ESCAPED)
