from importlib import import_module

measure = import_module("benchmarks.measure")


def test_one_round_has_no_spread():
    timings = measure.interleaved({"sum": lambda: sum(range(100))}, rounds=1)

    timing = timings["sum"]
    assert timing.median == timing.low == timing.high > 0
    assert timing.rounds == 1
