"""The command `tactile`: a table of what it does, and the folder of a lab."""
