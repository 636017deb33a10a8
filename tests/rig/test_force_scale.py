"""Load cells and scales: their lines, settling, and the label that a hold gets."""

from pathlib import Path

import numpy as np
import pytest
from support.drivers import FixedWorld, opening, running

from benchmarks.fake_clock import FakeClock
from recorder import Session, SessionWriter, StreamWriter, check, faults
from rig.bench.bench import bench_from
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.config import read_yaml
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES
from rig.devices.force.scale import GRAVITY, UNSETTLED, Reading, ScaleDriver, parse
from rig.devices.force.scale_emulator import ScaleEmulator, ScaleEmulatorConfig
from rig.devices.force.settings import ScaleConfig

CLOCK = SystemClock()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("   123.45 g  ", Reading(123.45, "g")),
        ("-    0.02    ", Reading(-0.02, "")),
        ("N     +    123.45 g  ", Reading(123.45, "g")),
        ("G     -      1.20 kg ", Reading(-1.2, "kg")),
        ("8388", Reading(8388.0, "")),
        ("-12.5", Reading(-12.5, "")),
        ("+ 0.5 N", Reading(0.5, "N")),
        ("Stat       High", None),
        ("Err 54", None),
        ("12.5 lb", None),
        ("1.2.3 g", None),
    ],
)
def test_lines_of_scales_are_read_or_refused(line: str, found: Reading | None) -> None:
    if found is None:
        with pytest.raises(ValueError, match=r"is no reading|unit 'lb'; known: mg"):
            parse(line)
    else:
        assert parse(line) == found


@pytest.mark.parametrize(
    ("protocol", "counts"), [("kern", None), ("sartorius", None), ("hx711", None), ("hx711", 5e4)]
)
def test_every_protocol_weighs_a_press_as_negative_fz(
    tmp_path: Path, protocol: str, counts: float | None
) -> None:
    config = ScaleConfig(
        protocol, str(tmp_path / "scale"), rate_hz=50.0, counts_per_n=counts, settle=0.1
    )
    settings, world = ScaleEmulatorConfig(device=config, lag=0.02), FixedWorld()
    world.record["wrench"][2] = -2.0
    emulator, driver = ScaleEmulator(settings, world, CLOCK), ScaleDriver(config, CLOCK)
    samples: list[dict[str, object]] = []
    with running(emulator), opening(driver):
        while not (samples and samples[-1]["settled"]):
            samples += driver.read(1.0)
    value = np.asarray(samples[-1]["value"])
    assert value[2] == pytest.approx(-2.0, abs=0.01)
    assert np.isnan(np.delete(value, 2)).all()
    assert samples[-1]["status"] == 0


class Fed(ScaleDriver):
    """Driver that takes lines from a test in place of a port."""

    def feed(self, line: str, now_ns: int) -> dict[str, object]:
        self._take(line.encode(), now_ns)
        return self._inbox.take(0.0)[0]


def test_a_reading_that_moves_is_kept_but_is_no_value() -> None:
    driver = Fed(ScaleConfig("kern", "none", rate_hz=10.0, settle_within=0.005), FakeClock())
    step = SECOND_NS // 10
    lines = ["0.00 g"] * 6 + ["51.00", "90.00", "101.00 g"] + ["101.97 g"] * 8
    samples = [driver.feed(line, k * step) for k, line in enumerate(lines, 1)]
    settled = [bool(sample["settled"]) for sample in samples]
    assert settled == [False] * 5 + [True] + [False] * 8 + [True] * 3
    assert samples[7]["reading"] == pytest.approx(-0.09 * GRAVITY)
    assert samples[7]["status"] == UNSETTLED
    assert np.isnan(np.asarray(samples[7]["value"])).all()
    assert np.asarray(samples[-1]["value"])[2] == pytest.approx(-1.0, abs=1e-4)


def test_lines_of_another_device_are_device_lost() -> None:
    driver = Fed(ScaleConfig("kern", "none"), FakeClock())
    for k in range(20):
        driver._take(b"OK", k)
    with pytest.raises(DeviceLost, match="and so were the 20 before; is it a kern, at 9600 baud"):
        driver._take(b"OK", 20)


SCALE = {"kind": "scale", "protocol": "kern", "address": "runfolder/scale"}


@pytest.mark.parametrize(
    ("scale", "hold", "text"),
    [
        ({**SCALE, "roles": ["guard"]}, 2000, "roles: found guard; allowed: label"),
        ({**SCALE, "axes_measured": ["Fx"]}, 2000, "axes_measured: .*allowed: Fz"),
        (SCALE, None, "hold_ms: 0; allowed with streams.scale: at least 1300"),
        ({**SCALE, "counts_per_n": 10.0}, 2000, "counts_per_n: found with protocol kern"),
    ],
)
def test_a_scale_that_guards_or_cannot_settle_is_refused(
    scale: dict[str, object], hold: float | None, text: str
) -> None:
    content = read_yaml(BENCHES / "gelsight.yaml", BENCHES)
    more = {} if hold is None else {"hold_ms": hold}
    with pytest.raises(ConfigError, match=text):
        bench_from({**content, "streams": {"scale": scale}, **more}, "bench.yaml")


def test_only_rows_between_settled_readings_get_a_label(tmp_path: Path) -> None:
    """In frames, Fz is NaN while the reading moves, and other axes always: never zero."""
    content = read_yaml(BENCHES / "gelsight.yaml", BENCHES)
    content = {**content, "force": None, "camera": None, "streams": {"scale": SCALE}}
    bench = bench_from({**content, "hold_ms": 2000}, "bench.yaml")
    spec = bench.row("scale").spec({"settles": True, "device_clock": "none"}, 10.0)
    assert [column.name for column in spec.columns][-2:] == ["reading", "t_ns"]
    path = tmp_path / "s.zarr"
    writer = SessionWriter.create(path, attrs={"sensor": "x"}, streams=[spec], targets={})
    writer.begin_run({"t0_ns": 0, "utc_ns": 0, "boot_id": "x"})
    with StreamWriter.open(writer.stream_path("scale")) as stream:
        for k in range(20):
            value = np.full(6, np.nan)
            if 5 <= k < 15:
                value[2] = -1.0
            row = {"value": value, "reading": -1.0, "seq": k, "status": 0 if 5 <= k < 15 else 1}
            stream.append(**row, t_ns=k * SECOND_NS // 10)
    writer.finish("complete", "", rate_hz=40.0)
    assert not faults(check(path))
    frames = Session(path).frames
    t = frames["t_ns"] / SECOND_NS
    labelled = np.isfinite(frames["wrench"][:, 2])
    assert labelled.any()
    assert t[labelled].min() >= 0.5
    assert t[labelled].max() <= 1.4
    assert np.isnan(np.delete(frames["wrench"], 2, axis=1)).all()
