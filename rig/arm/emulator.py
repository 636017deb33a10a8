"""A UR5e controller on a loopback address, for the unmodified ur_rtde and for our pose reader.

    python -m rig.arm.emulator --host 127.0.0.5 --state run/arm --world run/world

Listens on the controller's own ports (RTDE 30004, scripts 30001 to 30003, dashboard 29999) and on
31000 for faults to inject: see rig.arm.faults. ur_rtde's constructors hold the GIL while they wait
for an answer, so this must not run in the process of a client that uses ur_rtde.
"""

from __future__ import annotations

import argparse
import logging
import re
import selectors
import socket
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rig.arm import dashboard, faults, rtde
from rig.arm.controller import Controller
from rig.arm.emulator_clients import Client, LineClient, RtdeClient, ScriptClient
from rig.arm.kinematics import POSTURE, flange_pose
from rig.arm.robot import CYCLE
from rig.arm.rotation import compose
from rig.clock import SECOND_NS, Clock, SystemClock
from rig.disturbance import Disturbance, spoilt_bytes
from rig.emulation import SharedWorld, add_arguments, serve
from rig.latest import ARM_TRUTH
from rig.shared import LatestRecord

logger = logging.getLogger(__name__)

SCRIPT_PORTS = (30001, 30002, 30003)
_CYCLE_NS = round(CYCLE * SECOND_NS)
_LATE_CYCLES = 25
# Up to 50 ms of host delay is caught up, as packages of a real controller would arrive together;
# beyond that the emulated controller's clock stands still for the time lost, and that is counted.


class ArmEmulator:
    """Serves a `Controller` at 500 Hz against absolute deadlines, in one thread of its own.

    Args:
        host: Loopback address to listen on.
        controller: What to serve.
        clock: Paces the cycles.
        state: ARM_TRUTH record to publish each cycle's pose in.
        world: Where the contact force comes from.
    """

    def __init__(
        self,
        host: str,
        controller: Controller,
        clock: Clock,
        *,
        state: LatestRecord | None = None,
        world: SharedWorld | None = None,
    ) -> None:
        self._host = host
        self._controller = controller
        self._clock = clock
        self._state = state
        self._world = world
        self._world_count = 0
        self._clients: list[RtdeClient] = []
        self._peers: set[socket.socket] = set()
        self._owners: dict[str, RtdeClient] = {}
        # select(2) waits to the microsecond; epoll, in Python, rounds up to the millisecond.
        self._selector = selectors.SelectSelector()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._frozen_until_ns = 0
        # Of the plug, and of clients to come; each client's packages have a line of their own.
        self._line = Disturbance[bytes](clock, spoil=spoilt_bytes, on_change=self._on_plug)
        self.missed = 0
        """Cycles of host time in which the emulated controller's clock stood still."""

    @property
    def address(self) -> str:
        """The host it listens on."""
        return self._host

    def start(self) -> None:
        """Listen on all ports and run; returns when clients can connect.

        Raises:
            OSError: A port is taken.
        """
        try:
            self._listen(rtde.PORT, self._new_rtde)
            self._listen(dashboard.PORT, self._new_dashboard)
            self._listen(faults.PORT, self._new_faults)
            for port in SCRIPT_PORTS:
                self._listen(port, lambda peer: ScriptClient(peer, self._controller.start_program))
        except OSError:
            self._close_sockets()
            raise
        self._thread = threading.Thread(target=self._run, name="arm emulator", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop and close every connection; safe twice."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close_sockets()

    def _close_sockets(self) -> None:
        for key in list((self._selector.get_map() or {}).values()):
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()

    def _listen(self, port: int, make: Callable[[socket.socket], Client]) -> None:
        server = socket.socket()
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._selector.register(server, selectors.EVENT_READ, lambda: self._accept(server, make))
        server.setblocking(False)
        server.bind((self._host, port))
        server.listen(8)

    def _accept(self, server: socket.socket, make: Callable[[socket.socket], Client]) -> None:
        try:
            peer, _ = server.accept()
        except OSError:
            return
        if self._line.unplugged and make != self._new_faults:
            peer.close()
            return
        peer.setblocking(False)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = make(peer)
        if make != self._new_faults:
            self._peers.add(peer)
        self._selector.register(peer, selectors.EVENT_READ, lambda: self._serve(peer, client))

    def _serve(self, peer: socket.socket, client: Client) -> None:
        if client.receive():
            return
        self._selector.unregister(peer)
        self._peers.discard(peer)
        peer.close()
        if isinstance(client, RtdeClient):
            self._clients.remove(client)
            self._owners = {k: owner for k, owner in self._owners.items() if owner is not client}

    def _new_rtde(self, peer: socket.socket) -> Client:
        line = Disturbance[bytes](self._clock, spoil=spoilt_bytes)
        client = RtdeClient(peer, self._controller, self._owners, line)
        self._clients.append(client)
        return client

    def _new_dashboard(self, peer: socket.socket) -> Client:
        # The banner must come at once: ur_rtde waits 2 s for it and then gives up.
        return LineClient(
            peer, lambda line: dashboard.answer(self._controller, line), dashboard.BANNER
        )

    def _new_faults(self, peer: socket.socket) -> Client:
        return LineClient(peer, lambda line: faults.answer(self._controller, self, line))

    def drop(self) -> None:
        """Close every RTDE connection."""
        _shut(client.peer for client in self._clients)

    def disturb(self, fault: str, **values: Any) -> dict[str, Any]:
        """Put a fault into the line of every RTDE client; see `rig.disturbance`."""
        reply = self._line.inject(fault, **values)
        for client in self._clients:
            client.line.inject(fault, **values)
        return reply | {"touched": sum(client.line.touched for client in self._clients)}

    def _on_plug(self) -> None:
        if self._line.unplugged:
            _shut(self._peers)

    def freeze(self, seconds: float) -> None:
        """Neither send nor read RTDE for so long [s]; connections stay, the arm goes on."""
        self._frozen_until_ns = self._clock.now_ns() + round(seconds * SECOND_NS)

    def _run(self) -> None:
        due_ns = self._clock.now_ns() + _CYCLE_NS
        while not self._stopping.is_set():
            wait = (due_ns - self._clock.now_ns()) / SECOND_NS
            for key, _ in self._selector.select(max(wait, 0.0)):
                if self._clock.now_ns() < self._frozen_until_ns and self._is_rtde(key.fileobj):
                    continue
                key.data()
            now_ns = self._clock.now_ns()
            if now_ns < due_ns:
                continue
            self._cycle(due_ns, now_ns)
            due_ns += _CYCLE_NS
            late = (now_ns - due_ns) // _CYCLE_NS
            if late > _LATE_CYCLES:
                self.missed += late
                due_ns += late * _CYCLE_NS

    def _is_rtde(self, fileobj: Any) -> bool:
        return any(client.peer is fileobj for client in self._clients)

    def _cycle(self, due_ns: int, now_ns: int) -> None:
        controller = self._controller
        # The World answers at a few hundred Hz at most: looking every fifth cycle is enough.
        if self._world is not None and controller.tick % 5 == 0:
            count, state = self._world.state()
            if count != self._world_count:
                self._world_count = count
                controller.wrench = np.array(state["wrench"])
        controller.cycle()
        if self._state is not None:
            self._state.write((due_ns, controller.robot.pose, controller.robot.speed))
        if now_ns >= self._frozen_until_ns:
            for client in self._clients:
                client.publish()


def _shut(peers: Iterable[socket.socket]) -> None:
    for peer in peers:
        try:
            peer.shutdown(socket.SHUT_RDWR)
        except OSError as error:
            logger.debug("client already gone: %s", error)


def _plain(word: str) -> str:
    """`word`; a negative exponent number written out, since argparse takes -1e-16 for an option."""
    if not re.fullmatch(r"-[\d.]+[eE][-+]?\d+", word):
        return word
    return f"{float(word):.17f}"


def main(argv: list[str] | None = None) -> int:
    """Run one emulated arm until told to end; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rig.arm.emulator", description=__doc__)
    add_arguments(parser)
    parser.add_argument("--state", type=Path, metavar="PATH", help="file to publish the pose in")
    parser.add_argument(
        "--pose",
        type=float,
        nargs=6,
        metavar="N",
        help="TCP pose at start: x y z [m] rx ry rz [rad], base frame (default: tool down)",
    )
    parser.add_argument(
        "--tcp",
        type=float,
        nargs=6,
        metavar="N",
        default=[0.0] * 6,
        help="TCP in the flange frame at start, as in the installation (default: the flange)",
    )
    parser.add_argument(
        "--force-limit",
        type=float,
        default=150.0,
        metavar="N",
        help="contact force that makes a protective stop [N] (%(default)s)",
    )
    arguments = parser.parse_args([_plain(word) for word in argv or sys.argv[1:]])
    tcp = np.array(arguments.tcp)
    pose = arguments.pose or compose(flange_pose(np.array(POSTURE)), tcp)
    try:
        controller = Controller(np.array(pose), tcp, force_limit=arguments.force_limit)
    except ValueError as error:
        parser.error(str(error))
    state = LatestRecord.publish(arguments.state, ARM_TRUTH) if arguments.state else None
    world = SharedWorld(arguments.world)
    emulator = ArmEmulator(arguments.host, controller, SystemClock(), state=state, world=world)
    try:
        return serve("arm", emulator, until_stdin_closes=arguments.until_stdin_closes)
    finally:
        world.close()
        if state is not None:
            state.close()


if __name__ == "__main__":
    sys.exit(main())
