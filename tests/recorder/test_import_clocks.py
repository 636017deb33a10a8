"""Clocks of pictures and forces recorded apart: found with their uncertainty, or asked."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from recorder import Session
from recorder.convert import Answers, MissingAnswer, draft_recordings, write_sessions
from recorder.convert.import_clocks import Untestable, find_clock
from recorder.convert.import_presses import Signal, force_signal

Floats = NDArray[np.float64]
SECONDS, FPS, RATE = 20.0, 30.0, 200.0
SHOWN, FELT = np.arange(SECONDS * FPS) / FPS, np.arange(SECONDS * RATE) / RATE


def pressing(t: Floats, seed: int, quiet: float = 0.0) -> Floats:
    """Return a pressing force (n,) [N] of contacts that are irregular, after a quiet time [s]."""
    random, force, begin = np.random.default_rng(seed), np.zeros_like(t), 1.0
    while begin < SECONDS - 3:
        rise, hold, fall = random.uniform(0.25, 0.7, 3)
        end, peak = begin + rise + hold + fall, random.uniform(1.5, 8)
        ramp = np.clip(np.minimum((t - begin) / rise, (end - t) / fall), 0, 1)
        force += peak * ramp**1.5 * (begin > quiet)
        begin = end + random.uniform(0.4, 1.2)
    return force


def cells(force: Floats, random: Any) -> Floats:
    """Return what pictures show of a force (n, 40): not in proportion to it."""
    shown = np.outer((force / 8) ** 0.7, np.linspace(10, 40, 40))
    return np.asarray(shown + random.normal(0, 1, shown.shape))


def ns(seconds: Floats) -> NDArray[np.int64]:
    return np.round(1e9 * seconds).astype(np.int64)


def signals(stamps: Floats, seed: int, quiet: float = 0.0) -> tuple[Signal, Signal]:
    random = np.random.default_rng(seed)
    wrench = np.full((len(FELT), 6), np.nan)
    wrench[:, 2] = random.normal(0, 0.02, len(FELT)) - pressing(FELT, seed, quiet)
    shown = cells(pressing(SHOWN, seed, quiet), random)
    return Signal("image", ns(stamps), shown), force_signal(ns(FELT), wrench, ["Fz"])


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("late", "drift", "step"),
    [(0, 0, 0), (0.7, 0, 0), (-0.7, 0, 0), (0, 0.01, 0), (0.5, -0.01, 0), (0.3, 0, 0.4)],
)
def test_lag_drift_and_a_step_are_found_within_their_uncertainty(
    late: float, drift: float, step: float, seed: int
) -> None:
    stamps = SHOWN * (1 + drift) + late + step * (SHOWN > SECONDS / 2)
    fit = find_clock(*signals(stamps, seed), "x")
    wrong = np.abs(1e-9 * fit.moved(ns(stamps)) - SHOWN)
    force = pressing(SHOWN, seed) > 0.05
    assert wrong[force].max() < 2 * fit.sigma < 1 / FPS
    assert (abs(fit.drift) > 0.005, bool(fit.step)) == (drift != 0, step != 0)
    assert fit.untested == ()


def test_clocks_that_cannot_be_told_are_asked_for_and_quiet_parts_are_named() -> None:
    assert find_clock(*signals(SHOWN, 0, quiet=8), "x").untested == ("the first third",)
    sensed, force = signals(SHOWN + 0.3 * (SHOWN > 7) - 0.3 * (SHOWN > 14), 1)
    with pytest.raises(MissingAnswer, match=r"parts of it differ by \d+ ms; say --lag"):
        find_clock(sensed, force, "x")
    noise = np.random.default_rng(0).normal(0, 1, sensed.rows.shape)
    with pytest.raises(Untestable, match="cannot be found: they correlate by"):
        find_clock(Signal("image", sensed.t_ns, noise), force, "x")


def bag(path: Path, stamps: Floats) -> Path:
    """Write an MCAP of taxels at `SHOWN`, and forces at `FELT` with some stamps [s]."""
    from mcap.writer import Writer

    random, start = np.random.default_rng(3), 1.7e9
    counts = np.round(30_000 + np.tile(cells(pressing(SHOWN, 3), random), 2)[:, :48])
    rows: list[tuple[float, float, str, Any]] = []
    for t, row in zip(SHOWN, counts, strict=True):
        rows.append((t, start + t, "/taxels", {"counts": row.reshape(16, 3).tolist()}))
    for t, stamp, force in zip(FELT, stamps, pressing(FELT, 3), strict=True):
        axes = {"x": None, "y": None, "z": -float(force)}
        rows.append((t, stamp, "/ft", {"force": axes, "torque": dict.fromkeys("xyz")}))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        topics = {
            each: writer.register_channel(each, "json", schema) for each in ("/taxels", "/ft")
        }
        for t, stamp, topic, content in sorted(rows, key=lambda row: row[0]):
            parts = {"sec": int(stamp), "nsec": round(stamp % 1 * 1e9)}
            data = json.dumps({"header": {"stamp": parts}, **content}).encode()
            log_ns = round(1e9 * (start + t + random.uniform(0.001, 0.004)))
            writer.add_message(topics[topic], log_ns, data, log_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("clock", ["one", "ahead", "fast", "uptime", "step"])
def test_stamps_of_another_clock_are_moved_to_that_of_the_log(clock: str, tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf", reason="needs the extra export")
    stamps = {"fast": FELT * 1.01, "uptime": FELT - 1.6e9, "ahead": FELT + 0.7, "one": FELT}
    stamps["step"] = FELT + 0.5 * (FELT > 9)
    path = bag(tmp_path / "x.mcap", 1.7e9 + stamps[clock])
    answers = Answers(sensor="skin", indenter="ball", trim=True, taxel_order="taxel")
    drafts = draft_recordings([path], [], answers)
    assert any("of another clock" in line for line in drafts[0].assumed) == (clock != "one")
    write_sessions(drafts, tmp_path / "s.zarr", answers)
    streams = Session(tmp_path / "s.zarr").streams
    assert (len(streams["taxels"]), len(streams["force"])) == (len(SHOWN), len(FELT))
    apart = np.interp(streams["taxels"].t_ns, streams["force"].t_ns, FELT) - SHOWN
    low, high = streams["taxels"].attrs["latency_calibration"]["interval_s"]
    assert np.abs(apart).max() < (high - low) / 2 < 1 / FPS
