"""Simulated sensors against measurements, against other tiers, and their time a frame."""
