"""Accuracy and speed of the simulator."""
