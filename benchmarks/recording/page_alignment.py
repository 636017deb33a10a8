"""Section of the page on alignment: error against time, and the effect of latency."""

from __future__ import annotations

from math import isfinite

from benchmarks.recording.alignment import Alignment, Method
from benchmarks.recording.markdown import table
from benchmarks.recording.motion import EXPOSURE, FORCE_NOISE, LATENCY, PEAK, PRESS_HZ

# File of the chart, in images/ next to the page.
ALIGNMENT_CHART = "recording-alignment.png"


def alignment(found: Alignment) -> str:
    """Return the section as Markdown."""
    lines = [
        "## Cost of alignment accuracy",
        "",
        f"A motion with known ground truth: {PRESS_HZ:g} presses a second up to {PEAK:g} N with "
        "shear, the tool straight down half the time and tilting up to 5 deg in between, applied "
        "to the mock bench's World. Camera 60 Hz with an exposure of "
        f"{1e3 * EXPOSURE:g} ms and a calibrated latency of {1e3 * LATENCY:g} ms, force 1 kHz with "
        f"noise of {FORCE_NOISE:g} N, pose 500 Hz, arrival times with jitter; rows at 40 Hz.",
        "",
        "Force is compared with the mean true force over the frame's exposure, pose with the "
        "true pose at its end, and an image with its tick (the marker that moves most). "
        "Time is that of a window of 16 rows of this stream alone.",
        "",
        f"![Error against time]({'images/' + ALIGNMENT_CHART})",
        "",
        table(
            ("stream", "method", "error rms", "max", "us a window of 16"),
            [row for one in found.methods for row in _method_rows(one)],
        ),
        "`read with the frame` is a loop that reads the force once, when the frame has arrived. "
        "`component-wise linear` interpolates the rotation vector as three numbers, which fails "
        "for a tool that points down, because the vector changes sign at half a turn.",
        "",
        f"A whole `Session.window(t, 16)` takes {1e3 * found.windows:.1f} ms with its images "
        f"decoded from JPEG ({16 / found.windows:,.0f} images/s) and "
        f"{1e6 * found.windows_align:.0f} us without: the cost of the method is negligible next to "
        "decoding.",
        "",
        "### Effect of an uncorrected camera latency",
        "",
        table(
            (
                "uncorrected latency",
                "force rms / max [N]",
                "position rms / max [mm]",
                "angle rms / max [deg]",
                "marker rms / max [px]",
            ),
            [
                (
                    f"{1e3 * one.uncorrected:g} ms" if one.uncorrected else "none (calibrated)",
                    *(
                        f"{error.rms:.3g} / {error.most:.3g}"
                        for error in (one.force, one.position, one.angle, one.marker)
                    ),
                )
                for one in found.latencies
            ],
        ),
    ]
    if found.mock:
        lines += [
            "On a session collected on the mock bench (tacpalm, real client libraries, emulated "
            "devices), compared with its World's ground truth at the time each picture shows; the "
            "emulated camera has zero exposure time and its latency is not calibrated:",
            "",
            table(
                ("stream", "method", "error rms", "max"),
                [row[:4] for one in found.mock for row in _method_rows(one)],
            ),
        ]
    else:
        lines += [f"No session of the mock bench: {found.mock_missing}.", ""]
    return "\n".join(lines)


def _method_rows(one: Method) -> list[tuple[str, ...]]:
    took = f"{1e6 * one.per_window:.0f}" if isfinite(one.per_window) else "-"
    return [
        (one.stream, one.method, f"{error.rms:.3g} {unit}", f"{error.most:.3g} {unit}", took)
        for unit, error in one.errors.items()
    ]
