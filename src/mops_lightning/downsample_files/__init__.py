"""Downsampling clouds and meshes from files into files."""
