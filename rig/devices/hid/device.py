"""Access to one HID device through hidapi's hidraw backend: find, open, read.

The module is `hidraw`, not `hid`: the wheel's `hid` uses libusb, which would detach the device from
the kernel and does not see virtual devices. Reading needs a permission that a udev rule gives:

    KERNEL=="hidraw*", ATTRS{idVendor}=="256f", MODE="0660", GROUP="plugdev"
"""

from __future__ import annotations

import os

import hidraw

from rig.core.errors import DeviceLost

# Length of a full-speed USB report [bytes].
_LONGEST = 64


class HidDevice:
    """One HID device, read report by report.

    Args:
        device: `/dev/hidrawN` or `vendor:product`.
        what: Description of the device, for errors.
        usage: HID usage page and usage of the required interface, if a device has several.
    """

    def __init__(self, device: str, what: str, usage: tuple[int, int]) -> None:
        self._device = device
        self._what = what
        self._usage = usage
        self._handle: hidraw.device | None = None
        self.path = ""
        """Path of the opened node."""

    def open(self) -> None:
        """Find and open the device."""
        self.close()
        self.path = self._device if "/" in self._device else self._found()
        handle = hidraw.device()
        try:
            handle.open_path(self.path.encode())
        except OSError as error:
            raise DeviceLost(f"{self._where}: {error}{self._hint()}") from error
        self._handle = handle

    def report(self, timeout: float) -> bytes:
        """Return the next report, empty if none comes within `timeout` [s]."""
        if self._handle is None:
            raise DeviceLost(f"{self._where}: not open")
        try:
            return bytes(self._handle.read(_LONGEST, max(1, round(1e3 * timeout))))
        except (OSError, ValueError) as error:
            raise DeviceLost(f"{self._where}: {error}; is it plugged in?") from error

    def close(self) -> None:
        """Close the device; may be called twice."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None

    @property
    def _where(self) -> str:
        return f"{self._what} at {self._device}"

    def _found(self) -> str:
        vendor, product = (int(part, 16) for part in self._device.split(":"))
        nodes = hidraw.enumerate(vendor, product)
        if not nodes:
            seen = sorted(
                {f"{node['vendor_id']:04x}:{node['product_id']:04x}" for node in hidraw.enumerate()}
            )
            raise DeviceLost(
                f"{self._where}: not found among {', '.join(seen) or 'no HID devices at all'}; is "
                "it plugged in?"
            )
        wanted = [
            node for node in nodes if (node["usage_page"], node["usage"]) == self._usage
        ] or nodes
        return str(wanted[0]["path"].decode())

    def _hint(self) -> str:
        if self.path.endswith(".hidraw"):
            return (
                f": {self.path} is an emulated node; is it plugged in? Only a process with the "
                "shim sees it: export LD_PRELOAD=$(python -m rig.devices.hid.shim)"
            )
        if not os.path.exists(self.path):
            return f": {self.path} is not there; is it plugged in?"
        if os.access(self.path, os.R_OK | os.W_OK):
            return f": {self.path} is not a HID device, or its driver has released it"
        vendor = self._device[:4] if ":" in self._device else "<vendor, see lsusb>"
        return (
            f": {self.path} may not be opened; put this line into "
            f'/etc/udev/rules.d/70-tactile-rig.rules and plug it in again: KERNEL=="hidraw*", '
            f'ATTRS{{idVendor}}=="{vendor}", MODE="0660", GROUP="plugdev"'
        )
