"""How long the paper's work takes, what each step of the solver is worth, and how far its floor is.

`python -m benchmarks speed` measures into one file a device and writes docs/results/speed.md from
all of them.
"""
