"""The verbs of `python -m learning`, a file each."""
