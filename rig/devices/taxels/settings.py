"""Bench file settings of the taxel sensor. Imports no vendor library."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from rig.core.stream_settings import StreamSettings

_TAXELS = 16


@dataclass(frozen=True, slots=True)
class XelaConfig(StreamSettings):
    """Settings of a XELA uSkin behind its vendor's server."""

    KIND: ClassVar[str] = "xela"
    STREAM: ClassVar[str] = "taxels"

    address: str = "ws://127.0.0.1:5000"
    """Address of `xela_server`."""
    sensor: str = "1"
    """Key of the sensor in the server's messages."""
    taxels: int = 16
    """Number of taxels: a 4 x 4 patch (XR1944, uSPa44). Sessions support no other."""
    rate_hz: float = 60.0
    """Expected messages per second; the server decides, the rig measures."""
    silence: float = field(default=1.0, metadata={"unit": "ms", "plausible": (5, 60000)})
    """Silence after which the server counts as lost [s]."""

    def __post_init__(self) -> None:
        """Reject a patch that sessions do not support.

        Raises:
            ValueError: Names the field, the value found and the values allowed.
        """
        if self.taxels != _TAXELS:
            raise ValueError(
                f"taxels: {self.taxels}; allowed: {_TAXELS} (4 x 4: XR1944, uSPa44); the 4 x 6 "
                "models (XR1946, uSPa46) have 24, which sessions do not hold"
            )
