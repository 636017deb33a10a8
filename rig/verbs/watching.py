"""The options of a page to watch a collection on, and the page they ask for."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rig.bench import Bench
from rig.errors import ConfigError
from rig.watch.gate import DEFAULT_PORT, LOOPBACK_HOST, Gate, is_loopback

if TYPE_CHECKING:
    from rig.collect.order import Order
    from rig.watch.page import Page
    from trajectories import Plan


def watch_options(parser: argparse.ArgumentParser) -> None:
    """Add --watch and --watch-host."""
    parser.add_argument(
        "--watch",
        type=int,
        nargs="?",
        const=DEFAULT_PORT,
        metavar="PORT",
        help=f"serve a page to watch on (port {DEFAULT_PORT} unless given; 0: any free one)",
    )
    parser.add_argument(
        "--watch-host",
        default=LOOPBACK_HOST,
        metavar="ADDRESS",
        help="address the page is served on (default: %(default)s, this machine only; any other "
        "asks whoever opens it for a token, which is printed)",
    )


@contextlib.contextmanager
def opened_page(
    options: argparse.Namespace, bench: Bench, folder: Path, order: Order, plan: Plan, total: int
) -> Iterator[Page | None]:
    """The page that was asked for, running; None without --watch.

    Raises:
        ConfigError: A port or an address that cannot be had.
    """
    if options.watch is None:
        if options.watch_host != LOOPBACK_HOST:
            raise ConfigError("--watch-host: goes with --watch only")
        yield None
        return
    if not 0 <= options.watch <= 0xFFFF:
        raise ConfigError(f"--watch: found {options.watch}; allowed: 0 to 65535")
    from rig.watch.facts import page_job
    from rig.watch.page import Page

    gate = Gate(options.watch_host, options.watch)
    with Page(page_job(gate, bench, folder, order, plan, total)) as page:
        print(f"watch it at {page.url}", flush=True)
        if not is_loopback(gate.host):
            print(
                "whoever has this address can see, pause and abort: the connection is not encrypted"
            )
        yield page
