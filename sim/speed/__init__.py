"""How long the paper's work takes, what each step of the solver is worth, and how far its floor is.

`python -m sim speed` measures into one file a device and writes docs/speed.md from all of them.
"""
