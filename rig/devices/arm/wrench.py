"""The arm's own estimate of the force at its tool, by RTDE: `actual_TCP_force`.

An e-Series arm measures it in its flange, to a few newtons; others estimate it from the currents of
their joints. It detects a crash and is recorded, but no model learns from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from rig.devices.arm.reader import RtdePoseDriver


class RtdeWrenchDriver(RtdePoseDriver):
    """Stream of the arm's wrench, over a connection of its own.

    Columns: value (6,) float64 [N, N m] in the base frame, less the payload that is set in the
    controller, without any zero; device_t [s]; t_ns.
    """

    MORE: ClassVar[Mapping[str, str]] = {"actual_TCP_force": "wrench"}

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Return every sample since the last call, waiting up to `timeout` [s] for one."""
        return [
            {
                "value": np.array(sample["wrench"]),
                "device_t": sample["device_t"],
                "t_ns": sample["t_ns"],
            }
            for sample in super().read(timeout)
        ]

    def describe(self) -> dict[str, Any]:
        """Return properties that the controller gave on opening."""
        return {**super().describe(), "device": "wrench of the arm, RTDE actual_TCP_force"}
