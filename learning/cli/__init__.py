"""Commands of `python -m learning`, one file each."""
