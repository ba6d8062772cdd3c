"""``python -m mops_lightning.downsample_files IN OUT``."""

if __name__ == "__main__":
    # Worker processes import this module too and need nothing of what follows.
    from mops_lightning.downsample_files.cli import main

    main()
