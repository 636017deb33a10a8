"""A model with another scale: its folder, with ONNX, intervals and card; and its picture."""

import io
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from learning.errors import LearningError
from learning.force.calibrate import IntervalCalibration
from learning.force.export import export_onnx
from learning.force.intervals import Intervals, Scale
from learning.force.loading import load_force_model
from learning.force.made_for import CHOICE
from learning.force.model import AXES, ForceModel
from learning.training.checkpoint import MODEL, Config, read_model_folder, save_weights
from recorder.charts import chart
from recorder.store import replace_file

CARD = "card.md"
# Line of a card.
_SCALE = re.compile(r"^\*\*Scale .*$", re.MULTILINE)


def learned_indenters(model_folder: Path) -> tuple[str, ...]:
    """Return the indenters that a model of `tactile force` learned from."""
    chosen = read_model_folder(model_folder).config.metadata.get(CHOICE)
    if chosen is None:
        raise LearningError(f"{model_folder}: no choice; allowed: a model of `tactile force`")
    return tuple(chosen["seen"])


def scale_line(scale: Scale) -> str:
    """Return the line of a card and of commands about the scale of forces."""
    certainty = "assumed" if scale.assumed else "known"
    if scale.factor == 1.0:
        return f"**Scale {certainty}**: {scale.source}"
    return (
        f"**Scale {certainty}**: {scale.source}; at 90 % the true force is within "
        f"1/{scale.factor:.2f} and {scale.factor:.2f} times the predicted one"
    )


def write_model(
    folder: Path,
    config: Config,
    model: ForceModel,
    intervals: Intervals,
    card: Callable[[float], str],
) -> None:
    """Write a model into its folder, which has no other one; the weights come last.

    `card` returns the text of the card, for the difference of the ONNX from torch.
    """
    config.write(folder)
    intervals.write(folder)
    replace_file(folder / CARD, card(export_onnx(model, folder / "model.onnx")).encode())
    save_weights(model, folder / f"{MODEL}.safetensors")


def rescale(
    model_folder: Path, out: Path, factor: float | Sequence[float], intervals: Intervals
) -> None:
    """Write a model whose forces are multiplied by a factor, or one for each axis, to a new folder.

    `intervals` are those of the multiplied forces. The folder appears once it is complete.
    """
    folder, model = read_model_folder(model_folder), load_force_model(model_folder)
    factors = model.low.new_tensor(np.broadcast_to(factor, 3).tolist())
    model.low.mul_(factors)
    model.high.mul_(factors)
    new = out.with_name(f"{out.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    card = (model_folder / CARD).read_text(encoding="utf-8")
    line = f"{scale_line(intervals.scale)}. Errors and pictures above are of the model before that."
    card = _SCALE.sub(lambda _: line, card)
    write_model(new, folder.config, model, intervals, lambda difference: card)
    new.rename(out)


def calibration_picture(left_out: IntervalCalibration) -> bytes:
    """Draw predicted over expected forces of indenters that were left out, with intervals."""
    low, high = left_out.intervals.of(left_out.predicted)
    png = io.BytesIO()
    with chart(png, 9, 3.2) as figure:
        for axis, panel in enumerate(figure.subplots(1, 3)):
            expected, predicted = left_out.expected[:, axis], left_out.predicted[:, axis]
            if left_out.intervals.axes[axis] is None:
                panel.set_title(f"{AXES[axis]}: not measured")
                continue
            for name in np.unique(left_out.indenter):
                own = left_out.indenter == name
                panel.plot(expected[own], predicted[own], ".", ms=4, label=name)
            order = np.argsort(predicted)
            panel.fill_betweenx(predicted[order], low[order, axis], high[order, axis], alpha=0.15)
            ends = np.nanmin(expected), np.nanmax(expected)
            panel.plot(ends, ends, "k-", lw=0.8)
            panel.set_title(AXES[axis])
            panel.set_xlabel("expected [N]")
        figure.axes[0].set_ylabel("predicted [N]")
        figure.axes[-1].legend(fontsize=6, loc="lower right")
    return png.getvalue()
