"""``python -m mops_lightning``."""

from mops_lightning.cli import main

if __name__ == "__main__":
    main()
