"""Presses simulated in the paper: five depths at nine places."""

DEPTHS_MM = (0.3, 0.6, 0.9, 1.2, 1.5)
# Positions of the tip, along x and y.
PLACES_MM = (-4.0, 0.0, 4.0)
