"""Subcommands of `python -m sim`: one file each, with `add_arguments` and `run`."""
