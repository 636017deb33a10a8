"""Time of the paper's presses, gain of each optimisation of the solver, and roofline bound.

`python -m benchmarks speed` measures into one file per device and writes docs/results/speed.md from
all of them.
"""
