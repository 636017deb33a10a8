"""Faults injected into mock collections one by one, and the reaction of the rig.

Run with `python -m benchmarks faults`.
"""
