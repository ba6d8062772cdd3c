"""``python -m mops_lightning.compare FILES``."""

if __name__ == "__main__":
    from mops_lightning.compare.cli import main

    main()
