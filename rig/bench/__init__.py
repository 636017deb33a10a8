"""Bench files: devices and addresses, sensor, limits and plan."""
