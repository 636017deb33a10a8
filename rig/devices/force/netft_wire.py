"""Wire format of the ATI Net F/T box: RDT over UDP, and the XML page of its web server.

A request is 8 bytes, a record 36, both big-endian:

    request  uint16 0x1234 | uint16 command | uint32 samples (0: until stopped)
    record   uint32 rdt_sequence | uint32 ft_sequence | uint32 status | int32 Fx Fy Fz Tx Ty Tz

`rdt_sequence` numbers the records of a stream and wraps at 2**32: its gaps are lost packets.
`ft_sequence` is the number of the box's internal sample; for `status`, see `status_text`.

Counts are converted by `cfgcpf` and `cfgcpt` (counts per unit) and `scfgfu` and `scfgtu`
(names of the units) of `http://host/netftapi2.xml`.
"""

import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from rig.core.errors import ConfigError
from rig.devices.force import calibration

HEADER = 0x1234
COMMAND_STOP = 0
COMMAND_REALTIME = 2
COMMAND_BIAS = 0x42

REQUEST = struct.Struct(">HHI")
RECORD = struct.Struct(">III6i")

# Newton per unit, by the names the box uses.
_FORCE_NAMES = ("N", "kN", "lbf", "klbf", "kgf", "kg", "gf", "g")
FORCE_UNITS = {name: calibration.FORCE_UNITS[name] for name in _FORCE_NAMES}

# Newton metre per unit, by the names the box uses.
TORQUE_UNITS = {
    "N-m": 1.0,
    "N-mm": 1e-3,
    "kN-m": 1e3,
    "lbf-in": 0.1129848290276167,
    "lbf-ft": 1.3558179483314004,
    "kgf-cm": 9.80665e-2,
    "kg-cm": 9.80665e-2,
}

_STATUS_BITS = {
    30: "CPU or RAM error",
    29: "digital board error",
    28: "analog board error",
    27: "serial link error",
    26: "program memory error",
    25: "halted by configuration errors",
    24: "settings validation error",
    23: "configuration does not fit the calibration",
    22: "network error",
    21: "CAN bus error",
    20: "RDT error",
    19: "EtherNet/IP error",
    18: "DeviceNet error",
    17: "saturation or A/D error",
    16: "monitor condition latched",
    14: "watchdog error",
    13: "stack error",
    12: "serial EEPROM error",
    11: "serial flash error",
    10: "analog watchdog error",
    9: "excitation too high",
    8: "excitation too low",
    7: "artificial analog ground out of range",
    6: "power supply too high",
    5: "power supply too low",
    4: "serial link data error",
    3: "reference voltage error",
    2: "temperature error",
    1: "HTTP error",
}

# A gauge or the converter is at its limit: the load is too large to be measured.
SATURATION_MASK = 1 << 17

# Not errors: 31 only means that another bit is set, 16 is a user's threshold, and the field buses
# and the web server do not affect an RDT record.
_NO_ERROR_BITS = (31, 22, 21, 19, 18, 17, 16, 1)
# Bits that make a record's wrench untrusted.
ERROR_MASK = sum(1 << bit for bit in _STATUS_BITS if bit not in _NO_ERROR_BITS)


@dataclass(frozen=True, slots=True)
class Page:
    """Fields of netftapi2.xml that a client needs."""

    product: str = "Net F/T"
    """prodname"""
    serial: str = ""
    """calsn: serial number of the calibrated transducer."""
    runstat: int = 0
    """System status."""
    counts_per_force: float = 1e6
    """cfgcpf: counts per `force_unit`."""
    counts_per_torque: float = 1e6
    """cfgcpt: counts per `torque_unit`."""
    force_unit: str = "N"
    """scfgfu"""
    torque_unit: str = "N-mm"
    """scfgtu"""
    rate_hz: int = 1000
    """comrdtrate: records per second."""

    def scale(self) -> tuple[float, float]:
        """Return newton per count and newton metre per count."""
        if self.force_unit not in FORCE_UNITS:
            raise ConfigError(f"scfgfu: {self.force_unit!r}; known: {sorted(FORCE_UNITS)}")
        if self.torque_unit not in TORQUE_UNITS:
            raise ConfigError(f"scfgtu: {self.torque_unit!r}; known: {sorted(TORQUE_UNITS)}")
        if not (self.counts_per_force > 0 and self.counts_per_torque > 0):
            raise ConfigError(
                f"cfgcpf: {self.counts_per_force!r}, cfgcpt: {self.counts_per_torque!r}; "
                "allowed: above 0"
            )
        return (
            FORCE_UNITS[self.force_unit] / self.counts_per_force,
            TORQUE_UNITS[self.torque_unit] / self.counts_per_torque,
        )


def emit_request(command: int, samples: int = 0) -> bytes:
    """Return the request packet of `command`."""
    return REQUEST.pack(HEADER, command, samples)


def parse_request(packet: bytes) -> tuple[int, int] | None:
    """Return command and number of samples, or None if the packet is not a request."""
    if len(packet) != REQUEST.size:
        return None
    header, command, samples = REQUEST.unpack(packet)
    return (command, samples) if header == HEADER else None


# Fields of a `Page` by their tags, each with its parser.
_TAGS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "prodname": ("product", str),
    "calsn": ("serial", str),
    "runstat": ("runstat", partial(int, base=16)),
    "cfgcpf": ("counts_per_force", float),
    "cfgcpt": ("counts_per_torque", float),
    "scfgfu": ("force_unit", str),
    "scfgtu": ("torque_unit", str),
    "comrdtrate": ("rate_hz", int),
}
_OPTIONAL = ("prodname", "calsn")


def emit_page(page: Page) -> bytes:
    """Return the XML page with the fields of `page`."""
    root = ET.Element("netFTApi")
    for tag, (name, _) in _TAGS.items():
        value = getattr(page, name)
        text = f"{value:.17g}" if isinstance(value, float) else str(value)
        ET.SubElement(root, tag).text = f"0x{value:08x}" if name == "runstat" else text
    ET.SubElement(root, "comrdte").text = "1"
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True))


def parse_page(content: bytes) -> Page:
    """Parse netftapi2.xml."""
    try:
        root = ET.fromstring(content)
    except ET.ParseError as error:
        raise ValueError(f"not XML: {error}") from error
    texts = {tag: (root.findtext(f".//{tag}") or "").strip() for tag in _TAGS}
    missing = [tag for tag, text in texts.items() if not text and tag not in _OPTIONAL]
    if missing:
        raise ValueError(f"missing {missing}")
    return Page(**{name: read(texts[tag]) for tag, (name, read) in _TAGS.items()})


def status_text(status: int) -> str:
    """Return the meaning of a status word's bits as text; "ok" when none is set."""
    status &= 0xFFFFFFFF
    texts = [text for bit, text in _STATUS_BITS.items() if status >> bit & 1]
    documented = sum(1 << bit for bit in _STATUS_BITS) | 1 << 31
    if status & ~documented:
        texts.append(f"unknown bits 0x{status & ~documented:08x}")
    return "; ".join(texts) or ("unspecified error" if status else "ok")
