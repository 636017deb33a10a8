"""Accuracy, speed and stability of the simulator."""
