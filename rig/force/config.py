"""What the bench file says about the F/T sensor. No vendor library here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class NetFtConfig:
    """An ATI Net F/T box: where it is and how fast it shall send."""

    KIND: ClassVar[str] = "netft"

    host: str = "192.168.1.1"
    """Address of the box."""
    http_port: int = 80
    """Port of its configuration page."""
    udp_port: int = 49152
    """Port of its data (RDT)."""
    rate_hz: float = 1000.0
    """Records per second; the box knows whole numbers from 1 to 7000."""
    silence: float = field(default=0.5, metadata={"unit": "ms"})
    """Without a record for so long the box counts as lost [s]."""
