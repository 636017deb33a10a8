"""Faults put into mock collections one by one, and what the rig did: `python -m rig faults`."""
