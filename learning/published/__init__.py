"""Models that are installed with the package: an index, and a folder for each; no code."""
