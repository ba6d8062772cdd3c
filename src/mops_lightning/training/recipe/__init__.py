"""Training beyond the losses of the publications: ``recipe=fast``."""
