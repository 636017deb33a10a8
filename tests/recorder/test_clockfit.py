"""Offset and drift of device clocks, recovered under positive delays."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.sessions import record_run

from recorder import Session, SessionError, force_spec, pose_spec
from recorder.session.clocks import ClockFit, clock_lines, fit_clock, fit_clocks
from tests.support.few import few

OFFSET, DRIFT, LEAST_DELAY = 0.055, 80e-6, 0.004
START = 86_400.0
# The host has been up for a day: times are large, as in a lab [s].


def _arrivals(
    seed: int, *, rate_hz: float = 60.0, span: float = 600.0, shape: float = 2.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return true times [s], device times [s] and arrivals [ns] of a late, fast, warming clock.

    Delays: at least 4 ms, plus gamma of mean 1.5 ms, with 1 % spikes; thermal wander of 0.5 ms.
    """
    rng = np.random.default_rng(seed)
    true = START + np.arange(round(rate_hz * span)) / rate_hz
    wander = 0.5e-3 * np.sin(2 * np.pi * true / 600.0 + rng.uniform(0, 2 * np.pi))
    device = (true - START) * (1 + DRIFT) + wander - OFFSET
    delay = LEAST_DELAY + rng.gamma(shape, 1.5e-3 / shape, len(true))
    spikes = rng.random(len(true)) < 0.01
    delay[spikes] += rng.exponential(0.03, int(spikes.sum()))
    # A stream keeps its order: packets behind a late one are late too.
    arrived = np.maximum.accumulate(true + delay)
    return true, device, np.round(arrived * 1e9).astype(np.int64)


def fitted(device: np.ndarray, t_ns: np.ndarray) -> ClockFit:
    fit = fit_clock(device, t_ns)
    assert fit is not None
    return fit


@pytest.mark.parametrize("shape", few([1.0, 2.0], 1))
def test_55_ms_and_80_ppm_come_back_within_1_ms_and_a_tenth_rms(shape: float) -> None:
    for seed in range(20):
        true, device, t_ns = _arrivals(seed, shape=shape)
        fit = fitted(device, t_ns)
        assert len(fit.pieces) == 1
        piece = fit.pieces[0]
        error = fit.to_host(device) - LEAST_DELAY - true
        assert np.sqrt(np.mean(error**2)) < 0.1e-3
        assert abs(piece.offset - LEAST_DELAY - START - OFFSET) < 1e-3
        # The wander varies by up to 0.5 ms in 75 s; over the whole recording it averages out.
        assert piece.drift_ppm == pytest.approx(80, abs=3)
        raw = t_ns * 1e-9 - LEAST_DELAY - true
        assert np.sqrt(np.mean(raw**2)) > 10 * np.sqrt(np.mean(error**2))


def test_a_plain_line_through_the_arrivals_would_not_do() -> None:
    true, device, t_ns = _arrivals(3)
    host = t_ns * 1e-9
    line = np.polyval(np.polyfit(device, host - device, 1), device) + device
    assert np.sqrt(np.mean((line - LEAST_DELAY - true) ** 2)) > 1e-3


def test_a_short_recording_is_one_line() -> None:
    true, device, t_ns = _arrivals(1, span=8.0, rate_hz=500.0)
    assert np.abs(fitted(device, t_ns).to_host(device) - LEAST_DELAY - true).max() < 1e-3


@pytest.mark.parametrize("bits_tick", [(32, 1e-6), (24, 1e-6), (16, 1e-3)])
def test_counters_that_wrap_are_unwrapped(bits_tick: tuple[int, float]) -> None:
    period = 2.0 ** bits_tick[0] * bits_tick[1]
    _, device, t_ns = _arrivals(2, span=100.0)
    wrapped = (device + period - 50.0) % period
    fit = fitted(wrapped, t_ns)
    assert fit.wrap == pytest.approx(period)
    assert fit.resets == 0
    assert fit.pieces[0].drift_ppm == pytest.approx(80, abs=10)


def test_a_reset_of_the_device_begins_a_new_piece() -> None:
    true, device, t_ns = _arrivals(4, span=120.0)
    row = 3000
    restarted = np.where(np.arange(len(device)) < row, device, device - device[row])
    fit = fitted(restarted, t_ns)
    assert fit.resets == 1
    assert abs(fit.pieces[1].first_row - row) <= 2
    again = slice(fit.pieces[1].first_row + 2, None)
    assert np.abs(fit.to_host(restarted[again], piece=1) - LEAST_DELAY - true[again]).max() < 1e-3


def test_a_clock_that_is_set_forward_by_half_a_second_is_a_reset_too() -> None:
    _, device, t_ns = _arrivals(5, span=60.0)
    device[2000:] += 0.5
    fit = fitted(device, t_ns)
    assert fit.resets == 1
    assert abs(fit.pieces[1].first_row - 2000) <= 2


def test_a_stall_of_a_second_is_no_reset() -> None:
    _, device, t_ns = _arrivals(6, span=60.0, rate_hz=500.0)
    held = slice(10_000, 10_500)
    t_ns[held] = np.maximum(t_ns[held], t_ns[10_500])
    assert fitted(device, t_ns).resets == 0


def test_missing_device_times_are_left_out_and_too_few_give_no_fit() -> None:
    _, device, t_ns = _arrivals(7, span=30.0)
    device[::3] = np.nan
    assert fitted(device, t_ns).pieces[0].rows == int(np.isfinite(device).sum())
    assert fit_clock(device[:20], t_ns[:20]) is None
    assert fit_clock(np.full(100, np.nan), t_ns[:100]) is None


def test_a_fit_survives_json_to_the_last_bit() -> None:
    _, device, t_ns = _arrivals(8, span=60.0)
    fit = fitted(device, t_ns)
    again = ClockFit.from_json(fit.to_json())
    assert np.array_equal(again.to_host(device), fit.to_host(device))


def test_every_stream_with_a_clock_gets_its_fit_in_its_attributes(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    _, device, t_ns = _arrivals(9, span=20.0, rate_hz=200.0)
    rows, still = np.arange(len(t_ns)), np.zeros((len(t_ns), 6))
    pose = {"value": still, "device_t": device, "speed_scaling": 1.0 + 0 * rows, "t_ns": t_ns}
    force = {"value": still, "seq": rows, "status": 0 * rows, "t_ns": t_ns}
    streams = [pose_spec(200.0), force_spec(200.0, device={"rate_hz": 200.0})]
    record_run(path, {"pose": pose, "force": force}, streams=streams, rate_hz=60.0, clocks=True)
    session = Session(path)
    assert all("clock_fit" in session.streams[name].attrs for name in ("pose", "force"))
    with pytest.raises(SessionError, match="is closed"):
        fit_clocks(path)
    fit = ClockFit.from_json(session.streams["pose"].attrs["clock_fit"][0])
    assert fit.pieces[0].offset == fitted(device, t_ns).pieces[0].offset
    # The force's clock ticks 200 times per second of the host's: no drift was added.
    drift = session.streams["force"].attrs["clock_fit"][0]["pieces"][0]["drift_ppm"]
    assert abs(drift) < 40
    assert np.array_equal(session.streams["pose"].t_ns, t_ns)
    (line,) = clock_lines(session)
    assert "pose" in line
    assert " +- " in line
    assert "not applied" in line


def test_the_interval_of_a_drift_holds_the_drift_in_nineteen_of_twenty_recordings() -> None:
    inside = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        true = START + np.arange(12_000) / 200.0
        delay = LEAST_DELAY + rng.gamma(2.0, 0.75e-3, len(true))
        arrived = np.maximum.accumulate(true + delay)
        fit = fitted((true - START) * (1 + DRIFT), np.round(arrived * 1e9).astype(np.int64))
        piece = fit.pieces[0]
        inside += abs(piece.drift_ppm - 80) <= piece.drift_interval_ppm
        assert fit.drifts
    assert inside >= 36


def test_a_drift_that_means_nothing_is_silent() -> None:
    rng = np.random.default_rng(0)
    true = START + np.arange(600) / 60.0
    arrived = np.maximum.accumulate(true + rng.gamma(2.0, 0.02, len(true)))
    assert not fitted(true - START, np.round(arrived * 1e9).astype(np.int64)).drifts


def test_a_drift_without_an_interval_is_stored_and_read_as_unknown() -> None:
    # Samples at the ends of a recording only, with a long silence between.
    at = np.concatenate([np.arange(50) / 100, 60 + np.arange(50) / 100])
    fit = fitted(at, np.round(at * 1e9).astype(np.int64))
    assert np.isinf(fit.pieces[-1].drift_interval_ppm)
    again = ClockFit.from_json(json.loads(json.dumps(fit.to_json(), allow_nan=False)))
    assert np.isnan(again.pieces[-1].drift_interval_ppm)
    assert not again.drifts
