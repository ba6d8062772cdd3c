"""Weights files of trained samplers and task nets."""
