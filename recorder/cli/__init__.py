"""Commands of `python -m recorder`, one file each."""
