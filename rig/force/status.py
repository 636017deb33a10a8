"""Status words of the F/T sensors whose wire has none: what is wrong with one sample.

Where the Net F/T box has a bit for the same thing, the number is the same (rig/force/rdt.py).
"""

from __future__ import annotations

SATURATED = 1 << 17
"""A gauge is at the end of its output: the wrench is wrong."""
BEYOND_RATING = 1 << 16
"""An axis is beyond its rated range, before the tare: a warning; the bench's limits decide."""
LOST_BEFORE = 1 << 15
"""Samples between this one and the one before were lost."""
RECORD_ERROR_MASK = 0xFF
"""The error byte of an RS-232 record: not 0 when the controller says its values are wrong."""
