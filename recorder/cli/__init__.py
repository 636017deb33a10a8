"""Commands of `tactile session`, one file each."""
