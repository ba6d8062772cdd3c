"""Training, testing and resuming runs."""
