"""Names of files that a sweep's cells have beside a run's; reports know them too."""

ASIDE = ".attempts"
"""Folder in a cell's where earlier attempts are kept."""

FAILED = ".failed"
"""File in a cell's folder that says why its last start failed, be it before there was a record."""
