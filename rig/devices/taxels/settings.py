"""Bench file settings of the taxel sensor. Imports no vendor library."""

from dataclasses import dataclass, field
from typing import ClassVar

from rig.core.stream_settings import StreamSettings


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
    rows: int = 4
    """Rows of the patch: 4 of 4 x 4 (XR1944, uSPa44) and of 4 x 6 (XR1946, uSPa46)."""
    columns: int = 4
    """Taxels of each row."""
    axes: int = 3
    """X, Y and Z of each taxel, or the last of them."""
    rate_hz: float = 60.0
    """Expected messages per second; the server decides, the rig measures."""

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            if not 1 <= getattr(self, name) <= 1024:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: 1 to 1024")
        if not 1 <= self.axes <= 3:
            raise ValueError(f"axes: {self.axes!r}; allowed: 1 to 3")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows and columns of the patch, and axes of each taxel."""
        return self.rows, self.columns, self.axes
