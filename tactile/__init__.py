"""The command `tactile`: a table of commands, and `tactile init`."""
