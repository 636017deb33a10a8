"""Recorded forces as the Net F/T box that measured them would send them again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from recorder import SessionError
from rig.core.errors import ConfigError
from rig.core.playback import stated_rate
from rig.devices.force.netft_wire import Page

if TYPE_CHECKING:
    from recorder import Stream

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


def force_page(stream: Stream) -> Page:
    """Return the settings of the F/T box that recorded a force stream; defaults if not stored."""
    device = stream.attrs.get("device") or {}
    default = Page()
    page = Page(
        product=str(device.get("product") or default.product),
        serial=str(device.get("serial") or default.serial),
        counts_per_force=float(device.get("counts_per_force") or default.counts_per_force),
        counts_per_torque=float(device.get("counts_per_torque") or default.counts_per_torque),
        force_unit=str(device.get("force_unit") or default.force_unit),
        torque_unit=str(device.get("torque_unit") or default.torque_unit),
        rate_hz=max(round(stated_rate(stream)), 1),
    )
    try:
        page.scale()
    except ConfigError as error:
        raise SessionError(f"streams/{stream.name}: {error}") from None
    return page


def force_bias(stream: Stream) -> Floats:
    """Return the bias that was subtracted from every row of a force stream (6,) [N, N m]."""
    return np.array(stream.attrs.get("bias") or [0.0] * 6, np.float64)


def force_counts(value: Floats, bias: Floats, page: Page, name: str = "force") -> Ints:
    """Return the counts (n, 6) from which the driver computes exactly `value`.

    Args:
        value: As stored: measured minus bias (n, 6) [N, N m].
        bias: (6,) [N, N m].
        page: Settings of the box.
        name: Name of the stream, for errors.
    """
    scale = np.repeat(page.scale(), 3)
    whole = np.rint((value + bias) / scale)
    fits = (np.abs(whole) < 2**31).all(axis=1)
    counts = np.where(fits[:, None], whole, 0).astype(np.int64)
    # Repeats the driver's own arithmetic, to the last bit.
    again = counts.astype(np.float64) * scale - bias
    same = (again.view(np.int64) == np.ascontiguousarray(value).view(np.int64)).all(axis=1)
    bad = np.flatnonzero(~(fits & same))
    if bad.size:
        raise SessionError(
            f"streams/{name}: row {bad[0]}: {value[bad[0]].tolist()} is not a whole number of "
            f"counts of a box with {page.counts_per_force:g} counts per {page.force_unit} and "
            f"{page.counts_per_torque:g} per {page.torque_unit} ({bad.size} rows are not): "
            "it was not recorded from a Net F/T box, so its emulator cannot send it; replay the "
            f"other streams with --without {name}"
        )
    return counts
