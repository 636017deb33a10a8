"""Models that are installed with the package: a folder for each; no code."""
