"""Comparing methods of downsampling on a user's own files."""
