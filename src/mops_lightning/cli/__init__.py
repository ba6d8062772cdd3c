"""The command line: training, sweeps and the subcommands."""
