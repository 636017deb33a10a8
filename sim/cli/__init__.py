"""Subcommands of `tactile sim`: one file each, with `add_arguments` and `run`."""
