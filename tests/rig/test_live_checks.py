"""Doubts of a session are found while it grows, once, from what its streams have by then."""

import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import simplejpeg
from support.sessions import T0, Columns, make_session

from rig.acquire.live_checks import LiveChecks, look

DARK = simplejpeg.encode_jpeg(np.zeros((48, 64, 3), np.uint8))


def record(path: Path, seconds: float, *, ahead: bool = False) -> None:
    """Record a session again: a sign is wrong after 3.3 s, pictures are dark after 5.5 s.

    `ahead`: its last phase has no samples yet.
    """

    def change(name: str, columns: Columns) -> Columns:
        if name == "segments":
            columns["end_ns"][-1] += 400_000_000 * ahead
        elif name == "force":
            columns["value"][columns["t_ns"] > T0 + 3_300_000_000] *= -1
        elif name == "camera":
            columns["value"][330:] = [DARK] * len(columns["value"][330:])
        return columns

    shutil.rmtree(path, ignore_errors=True)
    make_session(path, seconds=seconds, change=change, finish=False)


def test_each_doubt_is_found_once_and_only_from_streams_that_have_come(tmp_path: Path) -> None:
    again = partial(record, tmp_path / "s.zarr")
    steps = [lambda: None, partial(again, 3.2), partial(again, 4.5, ahead=True)]
    steps += [partial(again, 5.2), partial(again, 6.8)]
    sent: list[set[str]] = []

    def poll(_: float) -> bool:
        if steps:
            sent.append(set())
            steps.pop(0)()
            return False
        return True

    pipe: Any = SimpleNamespace(poll=poll, send=lambda finding: sent[-1].add(finding.code))
    look(tmp_path / "s.zarr", pipe)
    assert sent[:3] == [set(), set(), set()]
    assert [{"wrong-sign", "dark"} & each for each in sent[3:]] == [{"wrong-sign"}, {"dark"}]


def test_a_process_of_its_own_looks_until_it_is_closed(tmp_path: Path) -> None:
    record(tmp_path / "s.zarr", 5.2)
    checks = LiveChecks(tmp_path / "s.zarr")
    assert checks._pipe.poll(60.0)
    assert "wrong-sign" in [each.code for each in checks.new()]
    checks.close()
    assert not checks._process.is_alive()
