"""Folders of made-up runs, and their tables."""

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
    }
    score = {"score_name": next(iter(metrics))}
    changes = {"dataset_fingerprint": "d", "task_weights_sha256": "w", **score, **changes}
    target = folder / f"{sampler}-{m}-{net}"
    target.mkdir()
    run_record.write(target, record(config=config, metrics=metrics, **changes))


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
    (folder / name).mkdir(parents=True)
    seconds = {"total": 1.0, "fit": cost}
    score = {"score_name": "test/generated/nre_cd", "dataset_fingerprint": "d"}
    content = record(config=config, metrics=metrics, seed=seed, seconds=seconds, **score)
    run_record.write(folder / name, content)
    return folder / name / run_record.FILE


def put_planes(folder):
    for number, alpha in enumerate((0.1, 1.0)):
        for tau in (0.5, 0.9):
            values = {"generated": 1 + number * tau, "matched": 2.0}
            put_cell(folder, f"a{alpha}{tau}", "mops", values, of={"alpha": alpha, "tau": tau})
        for gamma in (1e-5, 1e-3, 0.1):
            beta = 10.0**-number
            values = {"generated": gamma + beta, "matched": 3.0}
            put_cell(
                folder, f"b{beta}{gamma}", "samplenet", values, of={"beta": beta, "gamma": gamma}
            )


DEGREES = "rotation_error_deg"


def put_pairs(folder, sampler, m, value, net="pcrnet", resample=None, **changes):
    changes = {"score_name": f"test/sampled/{DEGREES}", **changes}
    if net == "icp":  # there are no weights to record
        changes["task_weights_sha256"] = None
    metrics = {f"test/sampled/{DEGREES}": value, f"test/full/{DEGREES}": 7.5}
    put(
        folder, sampler, m, metrics, "registration", net, settings={"resample": resample}, **changes
    )


def put_net(folder, name, metrics, task, net="pcrnet", points=1024, **settings):
    target = folder / f"{name}-{points}"
    target.mkdir()
    metrics = {f"test/full/{metric}": value for metric, value in metrics.items()}
    config = {
        "learn": "task",
        "names": {"task": task, "net": net, "dataset": "modelnet40", "sampler": "mops"},
        "task": {"net": {"_target_": net, "n_points": points, **settings}},
        "dataset": {"n_points": points},
    }
    made = {"score_name": next(iter(metrics)), "parameters": {"task": 1_025_000}}
    return run_record.write(target, record(config=config, metrics=metrics, **made))
