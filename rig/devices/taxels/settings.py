"""Bench file settings of the taxel sensor. Imports no vendor library."""

from dataclasses import dataclass, field
from typing import ClassVar

from rig.core.stream_settings import StreamSettings

# Rows and columns of XELA's patches, by number of taxels.
_PATCHES = {16: (4, 4), 24: (4, 6)}


@dataclass(frozen=True, slots=True)
class TaxelSettings(StreamSettings):
    """Settings that all arrays of taxels have; each adds a `rate_hz` [Hz] and its address."""

    STREAM: ClassVar[str] = "taxels"

    silence: float = field(
        default=1.0, kw_only=True, metadata={"unit": "ms", "plausible": (5, 60000)}
    )
    """Silence after which the device counts as lost [s]."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows and columns of the array, and axes of each taxel."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class XelaConfig(TaxelSettings):
    """Settings of a XELA uSkin behind its vendor's server."""

    KIND: ClassVar[str] = "xela"

    address: str = "ws://127.0.0.1:5000"
    """Address of `xela_server`."""
    sensor: str = "1"
    """Key of the sensor in the server's messages."""
    taxels: int = 16
    """16 of a 4 x 4 patch (XR1944, uSPa44), or 24 of a 4 x 6 one (XR1946, uSPa46)."""
    rate_hz: float = 60.0
    """Expected messages per second; the server decides, the rig measures."""

    def __post_init__(self) -> None:
        if self.taxels not in _PATCHES:
            raise ValueError(f"taxels: {self.taxels}; allowed: 16 (4 x 4), 24 (4 x 6)")

    def check_mock(self) -> None:
        """Reject a patch that the World of a mock bench does not have."""
        if self.taxels != 16:
            raise ValueError(f"taxels: {self.taxels}; allowed on a mock bench: 16, of its World")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows and columns of the patch, and axes of each taxel."""
        return (*_PATCHES[self.taxels], 3)
