"""Comparing methods of downsampling by the loss and the score of a task net."""
