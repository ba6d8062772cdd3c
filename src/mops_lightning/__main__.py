"""``python -m mops_lightning``."""

if __name__ == "__main__":
    # Worker processes import this module too and need nothing of what follows.
    from mops_lightning.cli.main import main

    main()
