"""The commands of `python -m rig`: one module each, with options and entry point."""
