"""`tactile calibrate-latency`: measure the signal's latency by light taps."""

import argparse
import dataclasses
from pathlib import Path

from recorder.session import Session
from rig.acquire.calibration import latency, store
from rig.acquire.calibration.store import LatencyCalibration
from rig.acquire.collector import CollectRequest
from rig.cli.options import recording_options
from rig.cli.recording import Recording, measured, record, recording_of
from rig.core.config import to_si
from rig.core.errors import SafetyStop


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    recording_options(parser, gauge=True)
    parser.add_argument("--taps", type=int, default=16, help="number of taps (%(default)s)")
    parser.add_argument(
        "--depth-mm", type=float, help="deepest tap [mm] (default: the depth of 1 N, at most 1.0)"
    )


def run(options: argparse.Namespace) -> int:
    """Tap, correlate and store the result; return the exit code."""
    depth = None if options.depth_mm is None else to_si(options.depth_mm, "mm")
    return calibrate(recording_of(options), taps=options.taps, depth=depth)


def calibrate(
    recording: Recording,
    *,
    taps: int = 16,
    depth: float | None = None,
    width_max: float = latency.WIDTH_MAX,
) -> int:
    """Measure and store the latency of the bench's signal; return the exit code.

    The deepest tap is `depth` deep [m], by default as deep as 1 N presses, at most 1 mm.
    `width_max` is the allowed width of the 95 % interval [s].
    """
    bench, content = recording.bench, recording.file.content
    # Apply the surface calibration only: an old latency correction would bias the new measurement.
    home = dataclasses.replace(recording.calibration(), latency=None)
    stream = latency.signal_of(bench)
    plan = latency.plan_for(bench, depth=depth, count=taps)
    path = recording.session("latency")
    request = CollectRequest.of(bench, path, plan, operator=recording.operator, calibration=home)

    def stored(session: Session) -> Path:
        lags = latency.evaluate(session, stream, latency.exposure_of(bench, stream))
        print("\n".join(latency.lines_of(lags, session)))
        refusal = latency.refusal(lags, width_max=width_max)
        if refusal is not None:
            raise SafetyStop(f"calibrate-latency: refused: {refusal}")
        calibration = LatencyCalibration(
            date_utc=store.now_utc(),
            method=latency.METHOD,
            mock=bench.mock,
            bench_sha256=store.bench_hash(content),
            stream=stream,
            device=store.device_name(bench, stream),
            latency=lags.latency,
            interval=(lags.latency - lags.half, lags.latency + lags.half),
            exposure=lags.exposure,
            gel_lead=lags.gel.value,
            ratio=lags.image.ratio,
            taps=lags.image.taps,
            reaction=latency.reaction_of(session, bench),
        )
        return store.store(recording.calibrations, bench.sensor, latency=calibration)

    return measured("calibrate-latency", path, record(recording, request), stored)
