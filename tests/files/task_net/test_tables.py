"""The tables, the curve and the page of a comparison by a task net."""

import pandas as pd
import pytest
from matplotlib.collections import LineCollection

from mops_lightning.files.task_net.keep import Choice
from mops_lightning.files.task_net.measure import LOSS
from mops_lightning.files.task_net.tables import FILES, Comparison, _form
from mops_lightning.metrics.info import MetricInfo

ACCURACY = MetricInfo("accuracy", label="accuracy", unit="%", scale=100.0, higher_is_better=True)

SCORES = {
    # method, number of points: the scores of two draws
    ("all points", 0): (0.8, 1.0),
    ("fps", 8): (0.4, 0.6),
    ("fps", 16): (0.5, 0.7),
    ("trained", 8): (0.6, 0.8),
}


def comparison(metric=ACCURACY, **more):
    rows = []
    for files, number in (("all", 12), ("choosing", 8), ("checking", 4)):
        for (method, m), scores in SCORES.items():
            for draw, score in enumerate(scores):
                rows.append((draw, files, m, method, 2 * (1 - score), score, number))
    columns = ["draw", "files", "m", "method", "loss", "score", "clouds"]
    frame = pd.DataFrame(rows, columns=columns)
    settings = {"files": 3, "own": ["trained"], "choices": [], "saved": None, **more}
    return Comparison(frame, metric, "net", **settings)


def test_tables_have_scores_and_losses_with_all_points_last():
    lines = comparison().text.splitlines()

    assert [line for line in lines if line.startswith("| ")] == [
        "| method | m=8 | m=16 |",
        "| fps | 50.00 ± 14.14 | **60.00** ± 14.14 |",
        "| trained | **70.00** ± 14.14 | - |",
        "| all points | 90.00 ± 14.14 | 90.00 ± 14.14 |",
        "| method | m=8 | m=16 |",
        "| fps | 1.000 ± 0.283 | **0.8000** ± 0.2828 |",
        "| trained | **0.6000** ± 0.2828 | - |",
        "| all points | 0.2000 ± 0.2828 | 0.2000 ± 0.2828 |",
    ]
    titles = [line for line in lines if "2 draws of 12 clouds from 3 files" in line]
    assert len(titles) == 2
    assert "accuracy (%) of net" in titles[0]
    assert "loss of net" in titles[1]


def test_net_of_ones_own_has_one_table_of_its_loss():
    text = comparison(metric=LOSS).text

    assert text.count("| method |") == 1


def test_curve_has_means_with_their_deviations_in_percent():
    axis = comparison()._curve().axes[0]

    fps, trained = axis.containers
    for container, name, means, style in (
        (fps, "fps", [50, 60], "--"),
        (trained, "trained", [70], "-"),
    ):
        line, _, (bars,) = container.lines
        assert container.get_label() == name
        assert line.get_ydata().tolist() == pytest.approx(means)
        assert line.get_linestyle() == style
        assert isinstance(bars, LineCollection)
        for (low, high), mean in zip(bars.get_segments(), means, strict=True):
            assert high[1] - mean == pytest.approx(14.142, abs=1e-3)
            assert mean - low[1] == pytest.approx(14.142, abs=1e-3)
    whole = axis.lines[-1]
    assert whole.get_label() == "all points"
    assert list(whole.get_ydata()) == pytest.approx([90, 90])
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["8", "16"]
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("points", "accuracy (%)")


def test_files_of_a_comparison_say_what_to_use_and_what_was_kept(tmp_path):
    saved = tmp_path / "best.safetensors"
    choices = [Choice(8, "fps"), Choice(16, "fps")]
    made = comparison(choices=choices, saved=saved)

    made.write(tmp_path / "out")

    out = tmp_path / "out"
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    assert (out / "table.md").read_text() == made.text
    pd.testing.assert_frame_equal(pd.read_csv(out / "table.csv"), made.frame)
    kept = f"Kept in {saved}, chosen on one half of the files:"
    assert made.text.splitlines()[-5:] == [
        kept,
        "- 8 points: fps",
        "- 16 points: fps",
        "",
        made.sentence,
    ]
    page = (out / "compare.html").read_text()
    assert made.sentence in page
    assert "8 points: fps" in page


@pytest.mark.parametrize(
    ("mean", "form"),
    [
        (0.0, ".2f"),
        (1234.5, ".0f"),
        (12.345, ".2f"),
        (0.12345, ".4f"),
        (0.0012345, ".6f"),
        (0.00012345, ".2e"),
        (-0.5, ".4f"),
    ],
)
def test_losses_have_four_digits(mean, form):
    assert _form(LOSS, mean) == form
    assert _form(ACCURACY, mean) == ".2f"
