"""The commands of `tactile`: one module each, with options and entry point."""
