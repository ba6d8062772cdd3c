"""The table of a comparison by registration, from its records."""

import pandas as pd

from mops_lightning.files.icp.measure import Score
from mops_lightning.files.icp.tables import grids_of, sentences_of, write_scores


def score(draw, method, degrees):
    return {
        "draw": draw,
        "registration": "plane",
        "m": 16,
        "method": method,
        "degrees": degrees,
        "aligned": 0.25,
        "shift": 0.5,
        "points": 16.0,
        "sampling": 0.001,
        "aligning": 0.002,
        "pairs": 4,
    }


def test_grid_has_means_spreads_and_paired_differences():
    frame = pd.DataFrame(
        [
            score(0, "fps_farthest", 1.0),
            score(0, "random", 2.0),
            score(1, "fps_farthest", 3.0),
            score(1, "random", 3.0),
        ]
    )

    (grid,) = grids_of(frame)

    assert grid.title == "plane, 16 points: 2 draws of 4 alignments"
    assert grid.head == [
        "method",
        "points",
        "rotation error (deg)",
        "against fps_farthest (%)",
        "below 2 deg (%)",
        "shift error",
        "sampling (ms)",
        "aligning (ms)",
    ]
    common = ["25.0 ± 0.0", "0.5000 ± 0.0000", "1.00", "2.00"]
    assert grid.rows == [
        ["fps_farthest", "16", "2.000 ± 1.414", "-", *common],
        ["random", "16", "2.500 ± 0.707", "+50.0 ± 70.7", *common],
    ]


def test_grid_of_one_draw_without_farthest_points_has_no_spread():
    (grid,) = grids_of(pd.DataFrame([score(0, "random", 2.0) | {"pairs": 1}]))

    assert grid.title == "plane, 16 points: 1 draw of 1 alignment"
    assert grid.rows[0][:4] == ["random", "16", "2.000", "-"]


def test_comparison_ends_in_the_method_to_use_for_every_registration(tmp_path):
    rows = []
    for draw, level in enumerate((1.0, 1.2, 0.9)):
        for registration in ("plane", "gicp"):
            factor = 0.8 if registration == "plane" else 1.1
            for method, error in (("fps_farthest", level), ("information", factor * level)):
                values = score(draw, method, error) | {"registration": registration}
                rows.append(Score(**values))

    text = write_scores(rows, tmp_path)

    assert text.splitlines()[-2:] == [
        "plane: Use information for 16 points; information is 20 % better than FPS at 16 (three "
        "draws).",
        "gicp: Use FPS from the farthest point for 16 points (three draws).",
    ]
    assert "plane: Use information" in (tmp_path / "compare.html").read_text()


def test_comparison_without_farthest_points_has_no_sentence():
    assert sentences_of(pd.DataFrame([score(0, "random", 2.0)])) == []
