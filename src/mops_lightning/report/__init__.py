"""Tables, plots and a page from run records: ``python -m mops_lightning.report FOLDER``."""
