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
    names = {"task": task, "net": net, "dataset": "modelnet40", "sampler": sampler}
    config = {
        "m": m,
        "names": names,
        "task": changes.pop("settings", {}),
        "sampler": changes.pop("of", {}),
        **changes.pop("config", {}),
    }
    score = {"score_name": next(iter(metrics))}
    changes = {"dataset_fingerprint": "d", "task_weights_sha256": "w", **score, **changes}
    made = record(config=config, metrics=metrics, **changes)
    return run_record.write(folder / f"{sampler}-{m}-{net}", made)


def edited(path, **changes):
    """Change fields of a written record."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def rows(text):
    """The cells of all tables of a report, without marks of the best values."""
    plain = re.sub(r"\*\*|</?u>", "", text)
    return [
        [cell.strip() for cell in line.strip()[1:-1].split("|")]
        for line in plain.splitlines()
        if line.startswith("| ")
    ]


def put_cell(folder, name, sampler, values, seed=0, cost=0.5, **settings):
    """A run of a sweep, whose settings beside the size are given dotted."""
    names = {"task": "reconstruction", "net": "autoencoder", "dataset": "shapes"}
    config = {
        "names": {**names, "sampler": sampler},
        "task": {"exact_up_to": 2048},
        "sampler": {"m": 32, **settings.pop("of", {})},
        **settings,
    }
    metrics = {f"test/{readout}/nre_cd": value for readout, value in values.items()}
    seconds = {"total": 1.0, "fit": cost}
    score = {"score_name": "test/generated/nre_cd", "dataset_fingerprint": "d"}
    content = record(config=config, metrics=metrics, seed=seed, seconds=seconds, **score)
    return run_record.write(folder / name, content)


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
    metrics = {f"test/full/{metric}": value for metric, value in metrics.items()}
    config = {
        "learn": "task",
        "names": {"task": task, "net": net, "dataset": "modelnet40", "sampler": "mops"},
        "task": {"net": {"_target_": net, "n_points": points, **settings}},
        "dataset": {"n_points": points},
    }
    size = {"task": 1_025_000}
    made = record(config, metrics=metrics, parameters=size, score_name=next(iter(metrics)))
    return run_record.write(folder / f"{name}-{points}", made)
