"""``python benchmarks/run.py``: measure, and write a record and a table."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import cases
import libraries
import measure
import torch
from inside import inside
from local import local
from measure import ceiling, machine

from mops_lightning.filesystem import atomic_write

ALL = {"inside": inside, "local": local, **cases.ALL}
COLUMNS = {
    "seconds": lambda value: f"{1000 * value:.3g} ms",
    "spread": lambda value: f"{1000 * value:.2g} ms",
    "share_of_ceiling": lambda value: f"{100 * value:.0f} %",
    "peak_bytes": lambda value: f"{value / 1e9:.2f} GB" if value > 1e8 else f"{value / 1e6:.2g} MB",
}


def main() -> None:
    """Run the chosen benchmarks one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", help=f"from {', '.join(ALL)}; default: all")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "cpu")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument(
        "--cpu-time", action="store_true", help="processor time, for one thread on a busy machine"
    )
    chosen = parser.parse_args()
    unknown = [name for name in chosen.cases if name not in ALL]
    if unknown:
        parser.error(f"unknown benchmark: {', '.join(unknown)}. Allowed: {', '.join(ALL)}")
    torch.set_num_threads(chosen.threads)
    if chosen.cpu_time:
        measure.clock = time.process_time
    torch.manual_seed(0)
    peak = ceiling(chosen.rounds)
    hardware = {**machine(), "others": libraries.versions()}
    record: dict[str, Any] = {"machine": hardware, "ceiling": peak, "cases": {}}
    record["clock"] = measure.clock.__name__
    print(f"ceiling: {peak['flops'] / 1e9:.0f} GFLOP/s, {peak['bytes'] / 1e9:.1f} GB/s", flush=True)
    for name in chosen.cases or ALL:
        record["cases"][name] = ALL[name](peak, chosen.rounds)
        print(f"\n{table(record['cases'][name])}", flush=True)
        with atomic_write(chosen.out.with_suffix(".json")) as temporary:
            temporary.write_text(json.dumps(record, indent=1) + "\n")
        with atomic_write(chosen.out.with_suffix(".md")) as temporary:
            temporary.write_text(markdown(record))
    print(f"\nwritten to {chosen.out}.json and .md")


def markdown(record: dict[str, Any]) -> str:
    """Return all tables of a record, with the machine and the ceiling."""
    where, peak = record["machine"], record["ceiling"]
    parts = [
        f"{where['cpu']}, {where['threads']} threads, {where['gpu'] or 'no GPU'}, torch "
        f"{where['versions']['torch']}, commit {(where['git']['commit'] or 'none')[:10]}"
        f"{' with changes' if where['git']['dirty'] else ''}. Ceiling in this run: "
        f"{peak['flops'] / 1e9:.0f} GFLOP/s (float32 products), {peak['bytes'] / 1e9:.1f} GB/s "
        "(copies). Medians per cloud; spread: distance between the quartiles over all rounds."
        f"{' Processor time.' if record.get('clock') == 'process_time' else ''}"
    ]
    for name, rows in record["cases"].items():
        parts += [f"## {name}", (ALL[name].__doc__ or "").strip(), table(rows)]
    return "\n\n".join(parts) + "\n"


def table(rows: list[dict[str, Any]]) -> str:
    """Return rows as a Markdown table."""
    names = [key for key in rows[0] if key not in (*COLUMNS, "rounds", "flop")]
    shown = [key for key in COLUMNS if any(key in row for row in rows)]
    lines = [f"| {' | '.join([*names, *(key.replace('_', ' ') for key in shown)])} |"]
    lines.append("|" + "---|" * len(names) + "--:|" * len(shown))
    for row in rows:
        cells = [f"{row[key]:,}" if isinstance(row[key], int) else row[key] for key in names]
        cells += [COLUMNS[key](row[key]) if key in row else "" for key in shown]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
