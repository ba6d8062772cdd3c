"""The sentence that ends a comparison."""

import pytest

from mops_lightning.metrics.info import MetricInfo
from mops_lightning.records.verdict import Gain, advise, verdict

ERROR = MetricInfo("error", higher_is_better=False)
ACCURACY = MetricInfo("accuracy", unit="%", scale=100, higher_is_better=True)

LEVEL = [1.0, 1.01, 0.99, 1.0, 1.0]
"""Errors of five draws."""


def times(factor, draws=LEVEL):
    return [factor * value for value in draws]


def test_verdict_with_a_crossing_names_it_and_the_gain_before_it():
    scores = {
        64: {"fps": LEVEL, "trained": times(1.02)},
        16: {"fps": LEVEL, "trained": times(0.91)},
    }

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == "Use FPS from 64 points on; your sampler is 9 % better at 16 (five draws)."


def test_verdict_of_a_sampler_that_always_wins_compares_it_with_fps():
    scores = {
        8: {"fps": LEVEL, "trained": times(0.8)},
        16: {"fps": LEVEL, "trained": times(0.96)},
    }

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == (
        "Use your sampler for 8 to 16 points; your sampler is 20 % better than FPS at 8 and 4 % at "
        "16 (five draws)."
    )


def test_verdict_of_a_sampler_that_never_wins_says_so():
    scores = {
        8: {"fps_farthest": LEVEL, "trained": times(1.2)},
        16: {"fps_farthest": LEVEL, "trained": times(1.1)},
    }

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == (
        "Use FPS from the farthest point for 8 to 16 points; your sampler is nowhere better, at "
        "best 10 % worse at 16 (five draws)."
    )


def test_verdict_of_a_sampler_level_with_fps_says_so():
    scores = {16: {"fps": [0.5], "trained": [0.5]}}

    sentence = verdict(scores, ACCURACY, ["trained"])

    assert sentence == (
        "Use FPS for 16 points; your sampler is nowhere better, at best level at 16 (one draw)."
    )


def test_verdict_of_percentages_counts_percentage_points():
    scores = {32: {"fps": [0.40, 0.42], "fps_farthest": [0.2, 0.2], "random": [0.50, 0.54]}}

    sentence = verdict(scores, ACCURACY)

    assert sentence == (
        "Use random for 32 points; random is 11 percentage points better than FPS at 32 (two "
        "draws)."
    )


def test_verdict_names_the_own_sampler_that_another_method_beats():
    scores = {
        16: {"fps": LEVEL, "covariance": times(0.88), "trained": times(0.91)},
        32: {"fps": LEVEL, "covariance": LEVEL, "trained": LEVEL},
    }

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == (
        "Use FPS from 32 points on; covariance is 12 % better at 16 (your sampler: 9 %) (five "
        "draws)."
    )


def test_verdict_names_the_own_sampler_beside_a_better_one_only_if_it_is_sure():
    scores = {16: {"fps": LEVEL, "covariance": times(0.88), "trained": [0.5, 1.4, 0.9, 1.0, 1.0]}}

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == (
        "Use covariance for 16 points; covariance is 12 % better than FPS at 16; your sampler is "
        "nowhere better beyond the spread, at best 4.1 % at 16 (five draws)."
    )


def test_verdict_names_the_own_sampler_before_methods_that_win_at_fewer_points():
    scores = {
        8: {"fps": LEVEL, "covariance": times(0.8), "trained": LEVEL},
        16: {"fps": LEVEL, "covariance": LEVEL, "trained": times(0.9)},
        1024: {"fps": LEVEL, "covariance": LEVEL, "trained": LEVEL},
    }

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == (
        "Use FPS from 1,024 points on; your sampler is 10 % better at 16; covariance is 20 % "
        "better at 8 (five draws)."
    )


def test_verdict_over_both_forms_of_farthest_points_calls_them_fps():
    scores = {
        16: {"fps": times(1.1), "fps_farthest": LEVEL, "random": times(2)},
        8: {"fps": LEVEL, "fps_farthest": times(1.1), "random": times(2)},
    }

    sentence = verdict(scores, ERROR)

    assert sentence == "Use FPS for 8 to 16 points (five draws)."


def test_verdict_of_an_own_sampler_better_within_the_spread_says_so():
    scores = {
        8: {"fps": LEVEL, "trained": [0.5, 1.5, 0.9, 1.0, 1.0]},
        16: {"fps": LEVEL, "trained": [0.5, 1.4, 0.9, 1.0, 1.0]},
    }

    sentence = verdict(scores, ERROR, ["trained"])

    assert sentence == (
        "Use FPS for 8 to 16 points; your sampler is nowhere better beyond the spread, at best "
        "4.1 % at 16 (five draws)."
    )


def test_verdict_writes_more_than_ten_draws_in_figures():
    assert verdict({8: {"fps": [1.0] * 11, "random": [2.0] * 11}}, ERROR).endswith("(11 draws).")


def test_verdict_with_several_own_samplers_names_each():
    scores = {
        8: {"fps": LEVEL, "a": times(0.9), "b": times(0.8)},
        16: {"fps": LEVEL, "a": times(0.9)},
        32: {"fps": LEVEL, "a": times(1.5)},
    }

    sentence = verdict(scores, ERROR, ["a", "b"])

    assert sentence == (
        "Use FPS from 32 points on; b is 20 % better at 8; a is 10 % better at 16 (five draws)."
    )


@pytest.mark.parametrize(("factor", "used"), [(0.995, "FPS"), (0.97, "random")])
def test_verdict_of_one_draw_takes_one_percent_as_level(factor, used):
    sentence = verdict({8: {"fps": [2.0], "random": [2.0 * factor]}}, ERROR)

    assert sentence.startswith(f"Use {used} for 8 points")
    assert sentence.endswith("(one draw).")


def test_verdict_without_farthest_points_or_rivals_is_empty():
    assert verdict({8: {"random": LEVEL, "voxel": LEVEL}}, ERROR) == ""
    assert verdict({8: {"fps": LEVEL}}, ERROR) == ""
    assert verdict({}, ERROR) == ""


def test_gain_is_the_mean_of_paired_ratios_and_twice_its_standard_error():
    gain = Gain.of([0.9, 1.6], [1.0, 2.0], ERROR)

    assert gain.mean == pytest.approx(15.0)  # 10 % and 20 %
    # The standard deviation is 7.0711, the standard error 5.
    assert gain.spread == pytest.approx(10.0)
    assert gain.is_sure


def test_gain_of_values_that_depend_on_each_other_has_the_spread_of_the_draws():
    values = [0.9, 1.6, 0.9, 1.6]  # two of each draw

    gain = Gain.of(values, [1.0, 2.0, 1.0, 2.0], ERROR, draws=2)

    # The standard deviation of 10, 20, 10 and 20 % is 5.7735.
    assert gain.spread == pytest.approx(2 * 5.7735 / 2**0.5, rel=1e-4)


@pytest.mark.parametrize(
    ("values", "rival"),
    [
        ([-1.5, -2.5], [-1.0, -2.0]),
        ([-0.5, 1.5], [0.0, 2.0]),
        ([-0.5], [0.0]),
    ],
)
def test_gain_over_values_not_all_above_zero_is_a_plain_difference(values, rival):
    gain = Gain.of(values, rival, ERROR)

    assert (gain.mean, gain.unit, str(gain)) == (0.5, "", "0.5")
    assert gain.is_sure


def test_gain_below_ten_percent_is_written_with_two_digits():
    assert str(Gain.of([0.985], [1.0], ERROR)) == "1.5 %"


def test_advice_takes_the_spread_from_parts():
    values = {"fps": [1.0, 1.0], "random": [0.9, 0.9]}  # draws that do not differ
    parts = {"fps": [1.0, 1.0, 1.0, 1.0], "random": [0.5, 1.3, 0.5, 1.3]}

    assert advise(8, values, ERROR).method == "random"
    advice = advise(8, values, ERROR, parts)
    assert advice.method == "fps"
    # The standard deviation of 50, -30, 50 and -30 % is 46.188; there are two draws.
    assert advice.gains["random"].spread == pytest.approx(2 * 46.188 / 2**0.5, rel=1e-4)
