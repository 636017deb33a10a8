"""The command `tactile`, of all packages; here are `tactile init` and `tactile schema`."""
