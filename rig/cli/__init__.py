"""The verbs of `python -m rig`, one a file: its options, and what it runs."""
