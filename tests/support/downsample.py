"""The command that downsamples files, in this process."""

from mops_lightning.files.downsample_cli import main
from tests.support.captured import captured


def call(*arguments):
    return captured(main, arguments)
