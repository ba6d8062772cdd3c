"""Tasks: a net, its loss and its metrics."""
