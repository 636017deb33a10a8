"""Commands of `tactile`, one file each."""
