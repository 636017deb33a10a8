"""The verbs of `python -m sim`: a file each, with `add_to` and `run`."""
