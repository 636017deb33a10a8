"""Options of the page, and values that are rejected before anything is started."""

import argparse
import ipaddress
import re
import urllib.parse
import urllib.request
from pathlib import Path

import pytest
from support.watching import BENCH, TARGETS

from recorder.command_line.options import Parser
from rig.acquire.collector import CollectRequest
from rig.cli.options import add_page, benches_option, calibration_options, opened_page
from rig.monitor.collection import CollectionJob
from trajectories import ForceDepth


def parse(*words: str) -> argparse.Namespace:
    parser = Parser()
    add_page(parser, "--watch", "page")
    benches_option(parser)
    calibration_options(parser)
    return parser.parse_args(words)


def test_nothing_is_served_unless_asked_for_and_the_port_has_a_default() -> None:
    assert parse().watch is None
    for words, address in (
        (("--watch",), ("127.0.0.1", 8765)),
        (("--watch", "9000"), ("127.0.0.1", 9000)),
        (("--watch", "0.0.0.0:0"), ("0.0.0.0", 0)),
        (("--watch", "[::1]:80"), ("::1", 80)),
    ):
        access = parse(*words).watch
        assert (access.host, access.port) == address


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_addresses_that_answer_are_printed_and_a_remote_one_has_the_token(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A tablet resolves no name of this machine, so the addresses are numbers."""
    options = parse("--watch", f"{host}:0")
    request = CollectRequest(tmp_path / "s.zarr", BENCH.trajectory, TARGETS)
    with opened_page(options.watch, options.calibrations, BENCH, tmp_path, request) as page:
        printed = capsys.readouterr().out
        urls = re.findall(r"watch it at (\S+)", printed)
        assert urls
        for url in urls:
            name = urllib.parse.urlsplit(url).hostname
            assert name is not None
            assert not ipaddress.ip_address(name).is_unspecified
            with urllib.request.urlopen(url, timeout=240) as answer:
                assert answer.status == 200
        if host == "127.0.0.1":
            assert printed == f"watch it at http://127.0.0.1:{page.port}/\n"
        else:
            assert f":{page.port}/?token=" in printed
            assert "not encrypted" in printed


def test_the_map_of_a_press_without_shear_has_one_direction(tmp_path: Path) -> None:
    plan = ForceDepth(depth_max=1.2e-3, repeats=3)
    request = CollectRequest(tmp_path / "s.zarr", plan, len(plan))
    job = CollectionJob.of(BENCH, tmp_path, request)
    assert job.directions == 1
    assert [(each.point, each.depth, each.direction) for each in job.targets] == [
        (1, 1.2e-3, -1)
    ] * 3
