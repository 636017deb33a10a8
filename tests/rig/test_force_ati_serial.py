"""The RS-232 controller's driver against its emulator on a pty: framing, lost bytes, errors."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st
from support.drivers import FixedWorld, collect, opening, running

from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.force.ati_serial import AtiSerialDriver
from rig.devices.force.ati_serial_emulator import AtiSerialEmulator, AtiSerialEmulatorConfig
from rig.devices.force.ati_serial_wire import BinaryFramer, SerialRecord, TextFramer, emit, parse
from rig.devices.force.sample_clock import LOST_BEFORE
from rig.devices.force.settings import RECORD_BYTES, AtiSerialConfig

CLOCK = SystemClock()
FORMS = ("binary", "ascii")
WRENCH = (1.0, -2.0, -3.5, 0.01, -0.02, 0.03)
COUNTS = st.integers(-32767, 32767)
RECORDS = st.builds(
    SerialRecord, st.integers(0, 9), st.tuples(COUNTS, COUNTS, COUNTS, COUNTS, COUNTS, COUNTS)
)

Fault = Callable[[int, bytes], Iterable[bytes]]


class FaultyAtiSerial(AtiSerialEmulator):
    """Emulator that passes each record of the stream and its number to `fault`."""

    fault: Fault | None = None
    rejected: str | None = None
    number = 0

    def records(self, content: bytes) -> Iterable[bytes]:
        self.number += 1
        return (content,) if self.fault is None else self.fault(self.number, content)

    def answer(self, command: str) -> bytes:
        return b"?" if command == self.rejected else super().answer(command)


@pytest.fixture(name="link")
def where_the_port_is(tmp_path: Path) -> Path:
    return tmp_path / "force"


def emulated(
    link: Path, noise: float = 0.0, rate_hz: float = 200.0
) -> AbstractContextManager[FaultyAtiSerial]:
    device = AtiSerialConfig(1280.0, 256.0, str(link), rate_hz=rate_hz)
    config = AtiSerialEmulatorConfig(device=device, noise=noise)
    emulator = FaultyAtiSerial(config, FixedWorld(wrench=WRENCH), CLOCK)
    return running(emulator)


def opened(link: Path, **options: Any) -> AbstractContextManager[AtiSerialDriver]:
    options = {"rate_hz": 80.0, "silence": 20.0, **options}
    driver = AtiSerialDriver(AtiSerialConfig(1280.0, 256.0, str(link), **options), CLOCK)
    return opening(driver)


@pytest.mark.parametrize("form", FORMS)
@given(record=RECORDS)
def test_parse_is_the_inverse_of_emit(form: str, record: SerialRecord) -> None:
    content = emit(record, form)
    assert len(content) == RECORD_BYTES[form]
    assert parse(content, form) == record


def test_a_record_looks_as_in_the_manual() -> None:
    record = SerialRecord(0, (-102, -99, -225, -20, 39, -39))
    assert emit(record, "ascii") == b"0,  -102,   -99,  -225,   -20,    39,   -39\r\n"
    assert emit(record, "binary").hex() == "00ff9aff9dff1fffec0027ffd9"


@given(record=RECORDS, cut=st.integers(0, 44))
def test_a_line_that_lacks_a_byte_is_no_record(record: SerialRecord, cut: int) -> None:
    content = emit(record, "ascii")
    assert parse(content[:cut] + content[cut + 1 :], "ascii") is None


@given(records=st.lists(RECORDS, min_size=1, max_size=5), size=st.integers(1, 60))
def test_text_is_framed_however_it_is_chopped(records: list[SerialRecord], size: int) -> None:
    content = b"".join(emit(record, "ascii") for record in records)
    framer = TextFramer()
    found = [
        each
        for start in range(0, len(content), size)
        for each in framer.feed(content[start : start + size])
    ]
    assert [each.record for each in found] == records
    assert not any(each.lost for each in found)


def test_the_bytes_that_came_after_a_record_are_told() -> None:
    lines = emit(SerialRecord(0, (1, 2, 3, 4, 5, 6)), "ascii") * 2 + b"0,"
    assert [each.behind for each in TextFramer().feed(lines)] == [47, 2]
    records = emit(SerialRecord(0, (1, 2, 3, 4, 5, 6)), "binary") * 2 + b"\0"
    assert [each.behind for each in BinaryFramer((100.0,) * 6).feed(records)] == [14, 1]


@given(lost=st.integers(39, 90), seed=st.integers(0, 1000))
def test_a_lost_byte_is_doubted_before_it_errs_by_more_than_a_jump(lost: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    steady = np.array([1280, -2560, -4480, 2560, -5120, 7680])
    true = [tuple((steady + rng.integers(-20, 21, 6)).tolist()) for _ in range(30)]
    content = b"".join(emit(SerialRecord(0, counts), "binary") for counts in true)
    framer = BinaryFramer((1280.0,) * 6)
    found = framer.feed(content[:lost] + content[lost + 1 :])
    assert framer.doubtful
    for each, counts in zip(found, true, strict=False):
        assert np.abs(np.subtract(each.record.counts, counts)).max() <= 1280 + 40


def test_the_first_record_of_a_start_counts_once_the_second_fits_it() -> None:
    framer = BinaryFramer((100.0,) * 6)
    first, strange = SerialRecord(0, (0,) * 6), SerialRecord(0, (5000, 0, 0, 0, 0, 0))
    assert framer.feed(emit(first, "binary")) == []
    assert framer.feed(emit(strange, "binary")) == []
    assert framer.doubtful


@pytest.mark.parametrize("form", FORMS)
def test_the_wrench_is_in_newton_and_newton_metre(link: Path, form: str) -> None:
    with emulated(link), opened(link, records=form) as driver:
        for sample in collect(driver, 3):
            assert sample["value"] == pytest.approx(WRENCH, abs=1e-3)
            assert sample["value"][3:] == pytest.approx(WRENCH[3:], abs=5e-6)
            assert sample["status"] == 0
        assert driver.describe()["records"] == form
        assert driver.describe()["replies"] == {}


@pytest.mark.parametrize(("form", "line_rate"), [("binary", 295.4), ("ascii", 85.3)])
def test_the_emulator_sends_no_more_than_the_line_carries(
    link: Path, form: str, line_rate: float
) -> None:
    with (
        emulated(link, rate_hz=38400 / 10 / RECORD_BYTES["binary"]) as emulator,
        opened(link, records=form) as driver,
    ):
        collect(driver, 3)
        assert emulator.rate_hz == pytest.approx(line_rate, abs=0.1)


def test_a_rate_the_line_cannot_carry_is_refused() -> None:
    with pytest.raises(ValueError, match=r"rate_hz: 200; allowed: .*up to 85 Hz.*38400 baud"):
        AtiSerialConfig(1280.0, 256.0, records="ascii", rate_hz=200.0)


@pytest.mark.parametrize("form", FORMS)
def test_lost_bytes_cost_records_and_never_make_false_ones(link: Path, form: str) -> None:
    def lossy(number: int, content: bytes) -> Iterable[bytes]:
        return (
            (content[: number % 12] + content[number % 12 + 1 :],)
            if number % 25 == 0
            else (content,)
        )

    with emulated(link, noise=0.01, rate_hz=290.0) as emulator:
        emulator.fault = lossy
        with opened(link, records=form) as driver:
            samples = collect(driver, 150)
            values = np.array([sample["value"] for sample in samples])
            # Noise is 0.01 N; a record combined from two would be off by newtons.
            assert np.abs(values[:, :3] - WRENCH[:3]).max() < 0.25
            assert driver.dropped >= 4
            assert driver.rejected == {"corrupt": driver.corrupt}
            marked = [k for k, sample in enumerate(samples) if sample["status"] & LOST_BEFORE]
            numbers = [sample["seq"] for sample in samples]
            gaps = [k for k in range(1, len(numbers)) if numbers[k] != numbers[k - 1] + 1]
            assert gaps
            assert set(gaps) <= set(marked)


@pytest.mark.parametrize("form", FORMS)
def test_the_controllers_error_is_the_status(link: Path, form: str) -> None:
    with emulated(link) as emulator, opened(link, records=form) as driver:
        assert collect(driver, 3)[-1]["status"] == 0
        emulator._world.record["wrench"] = (0.0, 0.0, -30.0, 0.0, 0.0, 0.0)
        sample = collect(driver, 10)[-1]
        while not sample["status"] & 0xFF:
            sample = collect(driver, 1)[-1]
        assert AtiSerialConfig.UNTRUSTED_MASK & sample["status"] == 1


def test_garbage_without_end_is_device_lost(link: Path) -> None:
    with emulated(link, rate_hz=290.0) as emulator:
        for form in FORMS:
            emulator.fault = None
            with opened(link, records=form, silence=0.5) as driver:
                collect(driver, 3)
                rng = np.random.default_rng(1)
                emulator.fault = lambda number, content, rng=rng: (rng.bytes(len(content)),)
                with pytest.raises(DeviceLost, match=r"complete record|restarts"):
                    collect(driver, 100_000)


def test_a_controller_in_mid_stream_is_stopped_and_set_up(link: Path) -> None:
    with emulated(link) as emulator:
        with serial.Serial(str(link), 38400) as port:
            port.write(b"QS\r")
            assert port.read(40)
        with opened(link) as driver:
            assert collect(driver, 3)[0]["value"] == pytest.approx(WRENCH, abs=1e-3)
            assert emulator._form == "binary"


def test_a_controller_that_knows_no_binary_is_refused(link: Path) -> None:
    with emulated(link) as emulator:
        emulator.rejected = "CD B"
        with pytest.raises(ConfigError, match="asked binary, got 45 bytes"), opened(link):
            pass


def test_what_a_setting_answers_is_kept(link: Path) -> None:
    with emulated(link) as emulator:
        emulator.rejected = "SA 4"
        with opened(link, average=4) as driver:
            assert driver.describe()["replies"] == {"SA 4": "?"}


def test_something_else_on_the_port_is_device_lost(link: Path) -> None:
    class Echo(AtiSerialEmulator):
        def _take_commands(self, timeout: float) -> None:
            threading.Event().wait(timeout / 10)
            if content := self._read():
                os.write(self._fd, content)

        def _read(self) -> bytes:
            try:
                return os.read(self._fd, 64)
            except BlockingIOError:
                return b""

    device = AtiSerialConfig(1280.0, 256.0, str(link))
    emulator = Echo(AtiSerialEmulatorConfig(device=device), FixedWorld(wrench=WRENCH), CLOCK)
    emulator.start()
    try:
        driver = AtiSerialDriver(AtiSerialConfig(1280.0, 256.0, str(link)), CLOCK)
        with pytest.raises(DeviceLost, match="any command"):
            driver.open(0.5)
    finally:
        emulator.close()


def test_two_programs_cannot_have_the_port(link: Path) -> None:
    with (
        emulated(link),
        opened(link),
        pytest.raises(DeviceLost, match="no other program"),
        opened(link),
    ):
        pass


def test_an_unplugged_adapter_is_device_lost(link: Path) -> None:
    with emulated(link) as emulator, opened(link) as driver:
        collect(driver, 3)
        emulator.close()
        with pytest.raises(DeviceLost, match="check the cable"):
            collect(driver, 100_000)
        with pytest.raises(DeviceLost, match="check the cable"):
            driver.read(1.0)


def test_a_pulled_cable_is_silence(link: Path) -> None:
    with emulated(link) as emulator:
        emulator.fault = lambda number, content: emulator.faults.passed(content)
        with opened(link, silence=0.3) as driver:
            collect(driver, 3)
            emulator.faults.inject("unplug")
            with pytest.raises(DeviceLost, match=r"no record for 0\.3 s"):
                collect(driver, 100_000)


def test_what_nobody_reads_is_lost_and_the_stream_recovers(link: Path) -> None:
    with emulated(link, rate_hz=290.0), opened(link) as driver:
        port: Any = driver._port
        collect(driver, 3)
        with port_held(port):
            threading.Event().wait(1.0)
        samples = collect(driver, 30)
        values = np.array([sample["value"] for sample in samples])
        assert np.abs(values[:, :3] - WRENCH[:3]).max() < 0.05


@contextmanager
def port_held(port: Any) -> Iterator[None]:
    """Keep the reader from reading, as on a stalled machine."""
    held, read = threading.Event(), port.read

    def nothing(size: int) -> bytes:
        if held.is_set():
            return bytes(read(size))
        threading.Event().wait(0.01)
        return b""

    port.read = nothing
    try:
        yield
    finally:
        held.set()
        port.read = read


def test_closing_leaves_the_controller_silent(link: Path) -> None:
    with emulated(link) as emulator:
        with opened(link) as driver:
            collect(driver, 3)
        with serial.Serial(str(link), 38400, timeout=1.0) as port:
            port.write(b"QR\r")
            answer = port.read_until(b"QR\r\n")
        assert answer.endswith(b"QR\r\n")
        assert not emulator._streaming
