"""Wire format of `xela_server`: JSON messages about a uSkin sensor, over WebSocket.

The first message is `{"message": "Welcome"}`; then, for every scan,

    1.7  {"message": 786, "time": 1619157045.62, "sensors": 1,
          "1": {"data": "FA00,FB00,...", "sensor": "1", "taxels": 16, "model": "XR1944",
                "calibrated": null}}
    1.8  the same plus "sendtime" and "type", and "time", "ups", "temp" in each sensor

`message` counts scans. `data` holds X, Y, Z of each taxel, row by row from the top left, as
hexadecimal uint16, possibly without leading zeros. `calibrated` is null, or as many numbers in N,
integers without a decimal point; it is not read. The rate cannot be set, and varies.

device_t is the sensor's own `time` (of the scan) where the layout has one, else the message's
`time`, or NaN if neither is a number. `sendtime` (when the server sent) is never used.
"""

import json
import re
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

_HEX = re.compile(r"0{0,4}[0-9A-Fa-f]{1,4}")
_OLD_SUITE = (
    "a suite before 1.7 (0.2 and others) sends another layout, which the rig does not read; "
    "update the XELA suite"
)
_SOCKET_IO = f"that is Socket.IO, not plain WebSocket; {_OLD_SUITE}"


class Scan(NamedTuple):
    """One message about one sensor."""

    message: int
    """The server's scan counter."""
    device_t: float
    """The server's time of the scan, seconds since 1970; NaN if not given."""
    counts: npt.NDArray[np.int32]
    """Raw counts, (taxels, axes)."""
    description: dict[str, Any]
    """Other entries of the sensor's part, without the data."""


def parse(text: str | bytes, sensor: str, taxels: int, axes: int = 3) -> Scan | None:
    """Return the scan of a `sensor` of taxels with `axes` each; None: it is the welcome."""
    if text[:1] in ("4", "0", b"4", b"0"):
        raise ValueError(f"{text[:24]!r}: {_SOCKET_IO}")
    message = json.loads(text)
    if not isinstance(message, dict):
        raise ValueError(f"not a JSON object: {text[:40]!r}")
    number = message.get("message")
    if isinstance(number, str) and number.startswith("Welcome"):
        return None
    if not isinstance(number, int) or isinstance(number, bool):
        is_old = any(isinstance(value, list) for value in message.values()) or "xyz" in message
        old = f"; {_OLD_SUITE}" if number is None and is_old else ""
        raise ValueError(f"message: {number!r}; expected a count{old}")
    part = message.get(sensor)
    if not isinstance(part, dict):
        sensors = [key for key, value in message.items() if isinstance(value, dict)]
        raise ValueError(f"no sensor {sensor!r}; the server has {sensors}")
    return Scan(
        message=number,
        device_t=_time(part, message),
        counts=np.array(_values(part, taxels, axes), np.int32).reshape(taxels, axes),
        description={key: value for key, value in part.items() if key != "data"},
    )


def _values(part: dict[str, Any], taxels: int, axes: int) -> list[int]:
    data = part.get("data")
    if not isinstance(data, str):
        raise ValueError(f"data: {type(data).__name__}; expected {axes} x {taxels} values as text")
    values = data.split(",")
    if len(values) != axes * taxels:
        model = part.get("model")
        raise ValueError(
            f"data: {len(values)} values; expected {axes} x {taxels} taxels"
            + (f"; it is a {model}: is it the sensor of the bench file?" if model else "")
        )
    # Not int(value, 16) alone, which accepts a sign, an underscore, 0x and blanks.
    bad = [value for value in values if not _HEX.fullmatch(value)]
    if bad:
        raise ValueError(f"data: {bad[0][:16]!r}; expected hexadecimal, nothing outside 0..FFFF")
    return [int(value, 16) for value in values]


def _time(part: dict[str, Any], message: dict[str, Any]) -> float:
    for seconds in (part.get("time"), message.get("time")):
        if isinstance(seconds, int | float) and not isinstance(seconds, bool):
            return float(seconds)
    return float("nan")
