from mops_lightning.errors import did_you_mean, printable


def test_did_you_mean_suggests_the_closest_names():
    assert did_you_mean("chiar", ["chair", "table"]) == (
        " Did you mean 'chair'? Allowed: chair, table."
    )
    assert did_you_mean("zzz", ["chair"]) == " Allowed: chair."


def test_printable_escapes_control_characters():
    assert printable("a\x1b]0;b\x07 é\n\udcff") == "a\\x1b]0;b\\x07 é\n\\udcff"
