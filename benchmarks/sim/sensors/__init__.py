"""Simulated sensors compared with measurements and other tiers, and their time per frame."""
