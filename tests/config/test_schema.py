import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from omegaconf import OmegaConf

from mops_lightning.config.composition import conf_dir
from mops_lightning.config.schema import schema

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def validator():
    made = schema()
    jsonschema.Draft7Validator.check_schema(made)
    return jsonschema.Draft7Validator(made)


def test_shipped_schema_is_up_to_date(validator):
    shipped = json.loads((conf_dir() / "schema.json").read_text())
    assert shipped == json.loads(json.dumps(validator.schema)), (
        "run: mops-lightning schema conf/schema.json"
    )


def test_sweeps_and_experiments_of_the_package_are_valid(validator):
    paths = [*ROOT.glob("sweeps/**/*.yaml"), *(conf_dir() / "experiment").glob("*.yaml")]
    assert paths
    for path in paths:
        content: Any = OmegaConf.to_container(OmegaConf.load(path))
        errors = [error.message for error in validator.iter_errors(content)]
        assert not errors, (path, errors)


@pytest.mark.parametrize(
    "content",
    [
        {"m": "many"},
        {"mm": 32},
        {"learn": "samplr"},
        {"sampler": {"tau_mim": 0.1}},
        {"sampler": {"tau_min": "low"}},
        {"task": {"net": {"chanels": 3}}},
        {"defaults": [3]},
        {"models": {"folder": "mine"}},
    ],
)
def test_mistakes_are_found(validator, content):
    assert list(validator.iter_errors(content))


def test_settings_of_no_file_or_of_one_task_are_allowed(validator):
    content = {
        "recipe": {"feature_distillation": 1.0},
        "sampler": {"min_size": 8},
        "models": {"path": "mine"},
        "task_nets": ["outputs/net"],
    }
    assert not list(validator.iter_errors(content))


def test_own_classes_and_interpolations_are_allowed(validator):
    own = {"_target_": "my.Sampler", "anything": 1}
    content = {"m": "${oc.env:M}", "sampler": own, "defaults": [{"override /sampler": "mine"}]}
    assert not list(validator.iter_errors(content))
