"""The command that downsamples files, in this process."""

from mops_lightning.files.downsample_cli import downsample as main
from tests.support import captured


def call(*arguments):
    return captured.captured(main, arguments)


def done(*arguments):
    return captured.done(main, arguments)


def refused(*arguments):
    return captured.refused(main, arguments)
