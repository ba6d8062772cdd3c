"""Metrics of sampled sets and of tasks, as torchmetrics classes and pure functions."""
