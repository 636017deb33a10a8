"""What the bench file says about the taxel sensor. No vendor library here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class XelaConfig:
    """A XELA uSkin behind its vendor's server."""

    KIND: ClassVar[str] = "xela"

    address: str = "ws://127.0.0.1:5000"
    """Where `xela_server` listens."""
    sensor: str = "1"
    """The sensor's key in the server's messages."""
    taxels: int = 16
    """Number of its taxels."""
    rate_hz: float = 60.0
    """Expected messages per second; the server decides, the rig measures."""
    silence: float = field(default=1.0, metadata={"unit": "ms"})
    """Without a message for so long the server counts as lost [s]."""
