from mops_lightning.records.environment import environment


def test_environment_names_versions():
    found = environment()
    assert {"python", "torch", "lightning", "mops-lightning"} <= set(found["versions"])
