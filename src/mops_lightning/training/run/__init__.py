"""One run: its stages, and the parts that they share."""
