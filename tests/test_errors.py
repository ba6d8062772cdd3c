from mops_lightning.errors import did_you_mean


def test_did_you_mean_suggests_the_closest_names():
    assert did_you_mean("chiar", ["chair", "table"]) == (
        " Did you mean 'chair'? Allowed: chair, table."
    )
    assert did_you_mean("zzz", ["chair"]) == " Allowed: chair."
