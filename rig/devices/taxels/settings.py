"""What the bench file says about the taxel sensor. No vendor library here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

_TAXELS = 16


@dataclass(frozen=True, slots=True)
class XelaConfig:
    """A XELA uSkin behind its vendor's server."""

    KIND: ClassVar[str] = "xela"

    address: str = "ws://127.0.0.1:5000"
    """Where `xela_server` listens."""
    sensor: str = "1"
    """The sensor's key in the server's messages."""
    taxels: int = 16
    """Number of its taxels: a 4 x 4 patch (XR1944, uSPa44). Sessions hold no other."""
    rate_hz: float = 60.0
    """Expected messages per second; the server decides, the rig measures."""
    silence: float = field(default=1.0, metadata={"unit": "ms"})
    """Without a message for so long the server counts as lost [s]."""

    def __post_init__(self) -> None:
        """Refuse a patch that sessions cannot hold.

        Raises:
            ValueError: Names the field, what was found and what is allowed.
        """
        if self.taxels != _TAXELS:
            raise ValueError(
                f"taxels: {self.taxels}; allowed: {_TAXELS} (4 x 4: XR1944, uSPa44); the 4 x 6 "
                "models (XR1946, uSPa46) have 24, which sessions do not hold"
            )
