"""Columns that devices could have sent, so that a session of them can be replayed."""

import numpy as np
from support.sessions import Columns

from rig.devices.force.netft_wire import Page

SCALE = np.repeat(Page().scale(), 3)


def as_devices_send(name: str, columns: Columns) -> Columns:
    """Convert forces to whole counts of a Net F/T box; other streams need no conversion."""
    if name == "force":
        counts = np.rint(columns["value"] / SCALE)
        return {**columns, "value": counts * SCALE - np.zeros(6)}
    if name == "taxels":
        return {**columns, "seq": columns["seq"] * 2 + 1}
    return columns
