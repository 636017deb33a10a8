"""The command `tactile`: the table of commands, and one way to run and end them."""
