"""Hard cases: a file for each family."""
