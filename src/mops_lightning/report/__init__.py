"""Tables, plots and a page from run records: ``mops-lightning report FOLDER``."""
