"""``python -m mops_lightning.report FOLDER``."""

from mops_lightning.report.cli import main

if __name__ == "__main__":
    main()
