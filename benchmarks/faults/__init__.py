"""Faults of devices, processes, disks and bench files, and what the rig loses or breaks by them."""
