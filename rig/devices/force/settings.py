"""Bench file settings of the F/T sensor. Imports no vendor library."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from rig.core.packaged import BENCHES, packaged
from rig.core.stream_settings import StreamSettings
from rig.devices.force.calibration import ToolTransform, read_calibration
from rig.devices.force.netft_wire import ERROR_MASK, SATURATION_MASK

# Status words of F/T sensors that transmit none: the problems of one sample.
# Where the Net F/T box has a bit for the same problem, the number is the same.
# A gauge is at the limit of its output: the wrench is wrong.
SATURATED = 1 << 17
# An axis is beyond its rated range, before the tare: a warning; the bench's limits decide.
BEYOND_RATING = 1 << 16
# Samples between this one and the previous one were lost.
LOST_BEFORE = 1 << 15

Axis = Literal["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"]
AXES: tuple[Axis, ...] = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


@dataclass(frozen=True, slots=True)
class ForceSettings(StreamSettings):
    """Settings that all F/T sensors have; each adds a `rate_hz` [Hz] and its address."""

    STREAM: ClassVar[str] = "force"
    UNTRUSTED_MASK: ClassVar[int] = 0
    """Status bits that make a wrench untrusted."""

    silence: float = field(
        default=0.5, kw_only=True, metadata={"unit": "ms", "plausible": (5, 60000)}
    )
    """Silence after which the sensor counts as lost [s]."""
    axes_measured: tuple[Axis, ...] = field(default=AXES, kw_only=True)
    """Axes that the sensor measures; values of the others, such as NaN, are stored and ignored."""

    def __post_init__(self) -> None:
        if not self.axes_measured or len(set(self.axes_measured)) < len(self.axes_measured):
            raise ValueError(
                f"axes_measured: {list(self.axes_measured)}; allowed: one or more of "
                f"{', '.join(AXES)}, each once"
            )

    @property
    def rated(self) -> tuple[float, ...] | None:
        """Rated load per axis (6,) in the frame of the wrench [N, N m]; None: not stated."""
        return None

    @property
    def hold(self) -> float:
        """Time at rest after a move in which readings settle [s]; 0: they follow at once."""
        return 0.0


@dataclass(frozen=True, slots=True)
class NetFtConfig(ForceSettings):
    """Settings of an ATI Net F/T box: its address and its rate."""

    KIND: ClassVar[str] = "netft"
    UNTRUSTED_MASK: ClassVar[int] = ERROR_MASK | SATURATION_MASK

    host: str = "192.168.1.1"
    """Address of the box."""
    http_port: int = 80
    """Port of its configuration page."""
    udp_port: int = 49152
    """Port of its data (RDT)."""
    rate_hz: float = 1000.0
    """Records per second; the box supports integers from 1 to 7000."""

    @property
    def address(self) -> str:
        """Address of the device, for display."""
        return self.host


@dataclass(frozen=True, slots=True)
class NidaqConfig(ForceSettings):
    """Settings of an ATI DAQ F/T transducer on six analog inputs of an NI card (NI-DAQmx)."""

    KIND: ClassVar[str] = "nidaq"
    UNTRUSTED_MASK: ClassVar[int] = SATURATED

    calibration: str
    """The transducer's .cal file; relative to the current folder, or a packaged one."""
    device: str = "Dev1"
    """Name of the card in NI MAX."""
    channels: str = "ai0:5"
    """Six inputs of the card, in the order of the gauges; read differentially."""
    rate_hz: float = 1000.0
    """Samples per second of the card's own clock."""
    saturated_at: float = 0.999
    """Fraction of the output range from which a gauge counts as saturated."""
    tool: ToolTransform = field(default_factory=ToolTransform)
    """Frame of the wrench; by default the transducer's own."""
    grpc: str | None = None
    """host:port of an NI gRPC Device Server that has the card; None: this computer has it."""

    def __post_init__(self) -> None:
        ForceSettings.__post_init__(self)
        if not self.rate_hz > 0:
            raise ValueError(f"rate_hz: {self.rate_hz!r}; allowed: above 0 Hz")
        if not 0 < self.saturated_at <= 1:
            raise ValueError(f"saturated_at: {self.saturated_at!r}; allowed: above 0, up to 1")

    def check_mock(self) -> None:
        """Reject a card in this computer, which cannot be emulated."""
        if self.grpc is None:
            raise ValueError(
                "grpc: missing; allowed: loopback:31763, the address of a mock bench's NI card"
            )

    @property
    def address(self) -> str:
        """Address of the device, for display."""
        physical_channels = f"{self.device}/{self.channels}"
        return physical_channels if self.grpc is None else f"{self.grpc} {physical_channels}"

    @property
    def rated(self) -> tuple[float, ...] | None:
        """Rated load per axis (6,) in the frame of the wrench, by the .cal file [N, N m].

        In a turned frame each axis has the lowest of the transducer's three.
        """
        rated = read_calibration(packaged(Path(self.calibration), BENCHES)).rated
        if any(self.tool.rotation):
            return (min(rated[:3]),) * 3 + (min(rated[3:]),) * 3
        return rated


@dataclass(frozen=True, slots=True)
class ScaleConfig(ForceSettings):
    """Settings of a load cell or scale on a serial port: Fz alone, slow, a label and no guard."""

    KIND: ClassVar[str] = "scale"

    protocol: Literal["hx711", "kern", "sartorius"]
    """Language on the wire: `hx711`, a board that prints one number a line; `kern`, the command w;
    `sartorius`, SBI with the command ESC P."""
    address: str = "/dev/ttyUSB0"
    """Serial port."""
    baud: int = 9600
    """Bits per second."""
    parity: Literal["none", "odd", "even"] = "none"
    """Parity; Sartorius scales are delivered with odd and 7 bits."""
    bits: Literal[7, 8] = 8
    """Data bits."""
    rate_hz: float = 10.0
    """Readings per second."""
    counts_per_n: float | None = None
    """Counts per newton of a board that prints counts; None: it prints grams, as scales do."""
    direction: Literal["down", "up"] = "down"
    """Direction of the force that a positive reading means: `down` presses on the sensor, which is
    negative Fz."""
    settle: float = field(default=0.5, metadata={"unit": "ms", "plausible": (50, 10000)})
    """Time for which readings must agree before they count as settled [s]."""
    settle_within: float = field(default=0.02, metadata={"unit": "n", "plausible": (0.0001, 10)})
    """Largest difference between readings that agree [N]."""
    silence: float = field(
        default=2.0, kw_only=True, metadata={"unit": "ms", "plausible": (100, 60000)}
    )
    """Silence after which the scale counts as lost [s]."""
    axes_measured: tuple[Axis, ...] = field(default=("Fz",), kw_only=True)
    """Fz; the other axes are stored as NaN."""
    align: Literal["latest", "nearest", "interpolated", "mean", "none"] | None = field(
        default="interpolated", kw_only=True
    )
    """Readings that have not settled are NaN, so only rows between two settled ones get a label."""
    roles: tuple[Literal["signal", "label", "guard"], ...] | None = field(
        default=("label",), kw_only=True
    )
    """Label only: a scale is too slow to stop an arm."""

    def __post_init__(self) -> None:
        if self.axes_measured != ("Fz",):
            raise ValueError(f"axes_measured: {list(self.axes_measured)}; allowed: Fz")
        if "guard" in (self.roles or ()):
            raise ValueError(
                "roles: found guard; allowed: label; a scale is too slow to stop an arm"
            )
        for name in ("baud", "rate_hz", "settle", "settle_within", "silence"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")
        if self.counts_per_n is not None and not self.counts_per_n > 0:
            raise ValueError(f"counts_per_n: {self.counts_per_n!r}; allowed: above 0")
        if self.counts_per_n is not None and self.protocol != "hx711":
            raise ValueError(
                f"counts_per_n: found with protocol {self.protocol}; allowed with hx711: a scale "
                "prints its unit"
            )

    @property
    def hold(self) -> float:
        """Time at rest in which readings settle and give at least three labels [s]."""
        return 2 * self.settle + 3 / self.rate_hz
