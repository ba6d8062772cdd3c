"""Mistakes in overrides of the Python entry."""

import pytest

from mops_lightning.config.compose import compose
from mops_lightning.errors import UserError


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("sampler=fp", "sampler=fp: no such choice. Did you mean 'fps'"),
        ("nope=3", "nope: no such setting"),
        ("logger=null", "choose one with logger=NAME"),
    ],
)
def test_compose_mistake_names_setting(override, said):
    with pytest.raises(UserError, match=said):
        compose([override])
