"""Faults of devices, processes, disks and bench files, and the losses that they cause."""
