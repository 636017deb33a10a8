"""An emulated device as its tape is played: how a row gets onto the wire."""

from __future__ import annotations

from typing import Protocol

from rig.replay.tape import Tape


class Outlet(Protocol):
    """What plays one stream.

    A driver that connects is given what it needs to open, and no row.
    """

    window: int
    """Rows that may be under way to the reader."""

    @property
    def address(self) -> str:
        """What a driver connects to."""

    def start(self) -> None:
        """Listen; raises OSError when the address cannot be had."""

    def send(self, place: int) -> None:
        """Send row `place` of the tape; raises OSError when the client is gone."""

    def idle(self) -> None:
        """Called about 20 times a second while no row is due."""

    def wake(self) -> None:
        """Make a reader that waits for a row look up, without a row: it is about to close."""

    def close(self) -> None:
        """Stop; safe twice."""


def make_outlet(name: str, tape: Tape, host: str) -> Outlet:
    """The emulated device of one stream; its vendor library is imported here and nowhere else."""
    if name == "force":
        from rig.force.netft_player import NetFtOutlet

        return NetFtOutlet(tape, host)
    if name == "pose":
        from rig.arm.rtde_player import RtdeOutlet

        return RtdeOutlet(tape, host)
    if name == "taxels":
        from rig.taxels.xela_player import XelaOutlet

        return XelaOutlet(tape, host)
    from rig.camera.mjpeg_player import MjpegOutlet

    return MjpegOutlet(tape, host)
