"""The configuration of the default run, as docs/configuration.md shows it."""

import re
from pathlib import Path

import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from mops_lightning.config.compose import compose

PAGE = (Path(__file__).parents[2] / "docs" / "configuration.md").read_text()


def test_page_shows_every_value_of_the_default_run(monkeypatch):
    monkeypatch.delenv("MOPS_CACHE", raising=False)
    (block,) = re.findall(r"```yaml\n(.*?)```", PAGE, flags=re.S)

    shown = yaml.safe_load(block)

    composed = OmegaConf.to_container(compose([]), resolve=True)
    assert shown == composed
    assert list(shown) == list(composed)
