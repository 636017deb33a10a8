"""Start of the simulator: no store of sessions where none is needed, no messages of Warp."""

from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp
from support.commands import python

from sim.device import check_device, kernel, loaded_together


@pytest.mark.slow
def test_a_press_that_is_only_printed_imports_no_zarr() -> None:
    program = (
        "import sys; from tactile.__main__ import main; "
        "main(['sim', 'press', '--tier', 'layer', '--json']); "
        "print({'zarr', 'rich', 'recorder.session'} & sys.modules.keys())"
    )
    assert python("-c", program).stdout.endswith("set()\n")


def test_a_program_that_simulates_gets_no_messages_below_warnings_unless_it_asks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)
    check_device("cpu")
    assert wp.config.log_level == wp.LOG_WARNING
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_DEBUG)
    check_device("cpu")
    assert wp.config.log_level == wp.LOG_DEBUG


@pytest.mark.parametrize(("handle", "streams"), [(None, 1), (7, 0)])
def test_a_device_left_on_the_null_stream_gets_a_stream_of_its_own(
    monkeypatch: pytest.MonkeyPatch, handle: int | None, streams: int
) -> None:
    given: list[object] = []
    device = SimpleNamespace(
        is_cuda=True, stream=SimpleNamespace(cuda_stream=handle), set_stream=given.append
    )
    monkeypatch.setattr(wp, "get_device", lambda name: device)
    monkeypatch.setattr(wp, "Stream", lambda of: of)
    check_device("cuda:0")
    assert given == [device] * streams


def test_kernels_made_in_the_context_are_loaded_at_its_end_those_of_a_group_as_one_module() -> None:
    def made(group: str) -> Any:
        @kernel(group=group)
        def one(out: wp.array[float]) -> None:
            out[wp.tid()] = wp.static(float(len(group)))

        return one

    with loaded_together("cpu"):
        kernels = [made(group) for group in ("unique", "tests.pair", "tests.pair")]
        assert not any(one.module.execs for one in kernels)
    assert all(one.module.execs for one in kernels)
    assert [one.module is kernels[1].module for one in kernels] == [False, True, True]
    assert not made("tests.later").module.execs
