"""Folders of made-up runs, and their tables."""

import json
import re

from mops_lightning.records import run_record
from mops_lightning.report.build import build_report
from mops_lightning.report.text import markdown
from tests.support.records import record


def table(folder, *metrics, mixed=False):
    report = build_report(folder, metrics, mixed)
    return markdown(report.grids, report.remarks)


def put(folder, sampler, m, metrics, task="classification", net="pointnet", **changes):
    config = {
        "m": m,
        "names": {"task": task, "net": net, "dataset": "modelnet40", "sampler": sampler},
        "task": changes.pop("settings", {}),
        "sampler": changes.pop("of", {}),
        **changes.pop("config", {}),
    }
    fields = {
        "score_name": first_of(metrics),
        "dataset_fingerprint": "d",
        "task_weights_sha256": "w",
        **changes,
    }
    written = record(config=config, metrics=metrics, **fields)
    return run_record.write(folder / f"{sampler}-{m}-{net}", written)


def first_of(metrics):
    return next(iter(metrics))


def edited(path, **changes):
    """Change fields of a written record."""
    fields = json.loads(path.read_text())
    fields |= changes
    path.write_text(json.dumps(fields))


def rows(text):
    """The cells of all tables of a report, without marks of the best values."""
    plain = re.sub(r"\*\*|</?u>", "", text)
    cells_of_rows = []
    for line in plain.splitlines():
        if line.startswith("| "):
            _, *cells, _ = line.strip().split("|")
            cells_of_rows.append([cell.strip() for cell in cells])
    return cells_of_rows


def put_cell(folder, name, sampler, values, seed=0, cost=0.5, **settings):
    """A run of a sweep, whose settings beside the size are given dotted."""
    of_sampler = settings.pop("of", {})
    config = {
        "names": {
            "task": "reconstruction",
            "net": "autoencoder",
            "dataset": "shapes",
            "sampler": sampler,
        },
        "task": {"exact_up_to": 2048},
        "sampler": {"m": 32, **of_sampler},
        **settings,
    }
    metrics = {}
    for readout, value in values.items():
        metrics[f"test/{readout}/nre_cd"] = value
    written = record(
        config=config,
        metrics=metrics,
        seed=seed,
        seconds={"total": 1.0, "fit": cost},
        score_name="test/generated/nre_cd",
        dataset_fingerprint="d",
    )
    return run_record.write(folder / name, written)


def put_planes(folder):
    for number, alpha in enumerate((0.1, 1.0)):
        for tau in (0.5, 0.9):
            values = {"generated": 1 + number * tau, "matched": 2.0}
            put_cell(folder, f"a{alpha}{tau}", "mops", values, of={"alpha": alpha, "tau": tau})
        for gamma in (1e-5, 1e-3, 0.1):
            beta = 10.0**-number
            values = {"generated": gamma + beta, "matched": 3.0}
            of = {"beta": beta, "gamma": gamma}
            put_cell(folder, f"b{beta}{gamma}", "samplenet", values, of=of)


DEGREES = "rotation_error_deg"


def put_pairs(folder, sampler, m, value, net="pcrnet", **changes):
    changes = {"score_name": f"test/sampled/{DEGREES}", **changes}
    if net == "icp":  # there are no weights to record
        changes["task_weights_sha256"] = None
    metrics = {f"test/sampled/{DEGREES}": value, f"test/full/{DEGREES}": 7.5}
    put(folder, sampler, m, metrics, "registration", net, **changes)


def put_net(folder, name, metrics, task, net="pcrnet", points=1024, **settings):
    of_full_clouds = {}
    for metric, value in metrics.items():
        of_full_clouds[f"test/full/{metric}"] = value
    config = {
        "learn": "task",
        "names": {"task": task, "net": net, "dataset": "modelnet40", "sampler": "mops"},
        "task": {"net": {"_target_": net, "n_points": points, **settings}},
        "dataset": {"n_points": points},
    }
    written = record(
        config,
        metrics=of_full_clouds,
        parameters={"task": 1_025_000},
        score_name=first_of(of_full_clouds),
    )
    return run_record.write(folder / f"{name}-{points}", written)
