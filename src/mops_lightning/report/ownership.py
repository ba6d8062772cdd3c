"""Files that a report may replace: those that it wrote itself."""

import re
from pathlib import Path

from mops_lightning.errors import UserError
from mops_lightning.records import run_record

MARK = "mops_lightning report"
"""Text in the metadata of pictures and pages."""

START = 200_000
"""Bytes at the start of a file that are searched for a mark."""

SIGNS = {
    ".md": re.compile(r"Test .+: .+ on .+; .+ sets|No sampler was tested; "),
    ".tex": re.compile(r"% needs \\usepackage{booktabs}"),
    ".csv": re.compile(r"folder,sampler,learn,seed,epochs,m,readout,metric,value,"),
}
"""How the texts of a report begin, those of earlier versions too."""


def check_replaceable(folder: Path, names: list[str]) -> None:
    """Refuse to write a report where a file has the name of one of its files.

    Pictures and pages of earlier versions have no mark: they count as written by the report if the
    table beside them is.

    Args:
        folder: of the report.
        names: of its files, the table first.

    Raises:
        UserError: the folder has such a file that no report has written.
    """
    table = folder / names[0]
    has_report = table.is_file() and _is_of_report(table)
    for name in names:
        path = folder / name
        if not path.is_file() or _is_of_report(path):
            continue
        if has_report and path.suffix not in SIGNS:
            continue
        raise UserError(
            f"{path}: was not written by report, which would replace it. Move it, or give its "
            "file another name."
        )


def check_records_file(path: Path) -> None:
    """Refuse to replace a file that does not hold run records.

    Raises:
        UserError: the file exists, and a line of it is no run record.
    """
    if not path.exists():
        return
    if not path.is_file():
        raise UserError(f"--records: {path} is not a file. Give the name of a .jsonl file.")
    try:
        lines = path.read_text().splitlines()
        if not lines:
            raise ValueError("it is empty")
        for line in lines:
            run_record.from_json(line, str(path))
    except (UserError, ValueError):
        raise UserError(
            f"--records: {path} exists and is not a file of run records, one a line, so it is not "
            "replaced. Give the name of a new .jsonl file."
        ) from None


def _is_of_report(path: Path) -> bool:
    with path.open("rb") as file:
        start = file.read(START)
    sign = SIGNS.get(path.suffix)
    if sign is not None:
        return sign.match(start.decode(errors="replace")) is not None
    return MARK.encode() in start
