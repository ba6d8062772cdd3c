"""Run records: what a run leaves behind, and how its figures are named and shown."""
