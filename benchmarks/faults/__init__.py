"""Faults put into mock collections one by one, and what the rig did.

Run with `python -m benchmarks faults`.
"""
