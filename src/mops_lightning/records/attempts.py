"""Names of files in the folders of a sweep's runs, which reports read too."""

ASIDE = ".attempts"
"""Folder in a cell's where earlier attempts are kept."""

FAILED = ".failed"
"""File in a cell's folder that says why its last start failed, be it before there was a record."""
