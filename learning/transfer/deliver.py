"""Last stage: the folder of the model, with ONNX, intervals and card; and the report."""

import base64
import io
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.config import settings_to_dict
from learning.errors import LearningError
from learning.force.calibrate import IntervalCalibration
from learning.force.export import export_onnx
from learning.force.intervals import COVERAGE, AxisError, Intervals
from learning.force.loading import load_force_model
from learning.force.model import AXES, ForceModel
from learning.training.checkpoint import MODEL, read_model_folder, save_weights
from recorder.charts import chart
from recorder.pages import render
from recorder.store import replace_file

Floats = NDArray[np.float64]
CARD = "card.md"
# Presses in a picture of the report.
PRESSES = 10


@dataclass(frozen=True, slots=True)
class Card:
    """Origin of a model, and the limits of what is known of it."""

    source: str
    target: str
    method: str
    """Kind of the labels of the target that were made of the source's."""
    translator: str
    seen: tuple[str, ...]
    """Indenters that the model was trained on."""
    pairs: int
    """Presses of both sensors that match."""
    intervals: Intervals
    history: tuple[str, ...] = ()
    """Changes of the scale since, such as weights."""


def deliver(
    model_folder: Path, out: Path, card: Card, factor: float | Sequence[float] = 1.0
) -> ForceModel:
    """Write a folder with a trained model, its ONNX, intervals and card; return the model.

    Its forces are multiplied by a factor, or one for each axis, as the intervals of the card are
    already. An existing folder is replaced once the new one is complete.
    """
    folder = read_model_folder(model_folder)
    model = load_force_model(model_folder)
    factors = model.low.new_tensor(np.broadcast_to(factor, 3).tolist())
    model.low.mul_(factors)
    model.high.mul_(factors)
    new = out.with_name(f"{out.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    content = settings_to_dict(card)
    del content["intervals"]
    sensors = [f"{card.source}-to-{card.target}"]
    metadata = {**folder.config.metadata, "sensors": sensors, "transfer": content}
    replace(folder.config, metadata=metadata).write(new)
    card.intervals.write(new)
    replace_file(new / CARD, render(Path(__file__).with_name(CARD), **card_values(card)).encode())
    export_onnx(model, new / "model.onnx")
    save_weights(model, new / f"{MODEL}.safetensors")
    shutil.rmtree(out, ignore_errors=True)
    new.rename(out)
    return model


def read_card(model_folder: Path, intervals: Intervals) -> Card:
    """Return the card of a delivered model."""
    content = read_model_folder(model_folder).config.metadata.get("transfer")
    if not isinstance(content, Mapping):
        raise LearningError(
            f"{model_folder}: found a model that learned no other sensor's labels; allowed: one of "
            "`tactile force --source`"
        )
    texts = {key: tuple(content[key]) for key in ("seen", "history")}
    return Card(**{**content, **texts, "intervals": intervals})


def learned_indenters(model_folder: Path) -> tuple[str, ...]:
    """Return the indenters that a model of `tactile force` learned from."""
    metadata = read_model_folder(model_folder).config.metadata
    return tuple(metadata.get("transfer", metadata.get("choice", {})).get("seen", ()))


def card_values(card: Card) -> dict[str, Any]:
    """Return what the template of the card is filled with."""
    lines = [
        (name, one.base, one.slope)
        for name, one in zip(AXES, card.intervals.axes, strict=True)
        if isinstance(one, AxisError)
    ]
    return {
        "card": card,
        "intervals": card.intervals,
        "scale": card.intervals.scale,
        "percent": round(100 * COVERAGE),
        "lines": lines,
        "unmeasured": [
            name for name, one in zip(AXES, card.intervals.axes, strict=True) if one is None
        ],
    }


# Report: one HTML page with pictures.


def write_report(
    out: Path,
    card: Card,
    matches: Sequence[str],
    pictures: Sequence[tuple[str, bytes]],
    curve: Sequence[Mapping[str, Any]],
) -> None:
    """Write the report of a transfer to a file.

    It has the card, the table of presses that match, captions and PNGs, and the errors over the
    number of labelled presses, if there are any.
    """
    encoded = [(text, base64.b64encode(png).decode()) for text, png in pictures]
    page = render(
        Path(__file__).with_name("report.html"),
        matches=matches,
        pictures=encoded,
        curve=curve,
        **card_values(card),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    replace_file(out, page.encode())


def calibration_picture(calibration: IntervalCalibration) -> bytes:
    """Draw predicted over expected forces of held-out indenters, with intervals."""
    low, high = calibration.intervals.of(calibration.predicted)
    png = io.BytesIO()
    with chart(png, 9, 3.2) as figure:
        for axis, panel in enumerate(figure.subplots(1, 3)):
            expected, predicted = calibration.expected[:, axis], calibration.predicted[:, axis]
            if calibration.intervals.axes[axis] is None:
                panel.set_title(f"{AXES[axis]}: not measured")
                continue
            for name in np.unique(calibration.indenter):
                own = calibration.indenter == name
                panel.plot(expected[own], predicted[own], ".", ms=4, label=name)
            order = np.argsort(predicted)
            panel.fill_betweenx(predicted[order], low[order, axis], high[order, axis], alpha=0.15)
            ends = np.nanmin(expected), np.nanmax(expected)
            panel.plot(ends, ends, "k-", lw=0.8)
            panel.set_title(AXES[axis])
            panel.set_xlabel("expected [N]")
        figure.axes[0].set_ylabel("predicted [N]")
        figure.axes[-1].legend(fontsize=6)
    return png.getvalue()


def forces_picture(
    predicted: Floats, before: Floats, intervals: Intervals, starts: Sequence[int]
) -> bytes:
    """Draw the forces (n, 3) [N] of some presses with intervals, and those of the source's model.

    `starts` are the first frames of the presses.
    """
    low, high = intervals.of(predicted)
    png = io.BytesIO()
    with chart(png, 9, 6.0) as figure:
        for axis, panel in enumerate(figure.subplots(3, 1, sharex=True)):
            panel.fill_between(np.arange(len(predicted)), low[:, axis], high[:, axis], alpha=0.25)
            panel.plot(predicted[:, axis], label="after transfer")
            panel.plot(before[:, axis], "--", lw=1, label="source's model")
            for start in starts:
                panel.axvline(start, color="0.85", lw=0.6, zorder=0)
            panel.set_ylabel(f"{AXES[axis]} [N]")
        panel.set_xlabel("frame")
        figure.axes[0].legend()
    return png.getvalue()


def lines_of(card: Card) -> Iterator[str]:
    """Yield the lines that commands print: half-widths, unmeasured axes and the scale."""
    intervals = card.intervals
    for name, one in zip(AXES, intervals.axes, strict=True):
        if one is None:
            yield f"{name}: not measured, so not predicted with an interval"
        else:
            yield f"{name}: +- {one.base:.3f} N +- {100 * one.slope:.1f} % of the force"
    scale = intervals.scale
    certainty = "scale assumed" if scale.assumed else "scale known"
    yield (
        f"{certainty}: {scale.source}; true forces are within 1/{scale.factor:.2f} and "
        f"{scale.factor:.2f} times the predicted ones"
    )
