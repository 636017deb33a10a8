"""Forces beyond those of the training: nets of a sensor's own labels, within and outside of them.

Each net is trained with each seed on the seen indenters of a simulated sensor, and tested on the
others. A frame is outside if a force component exceeds that of all training labels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.gauge.ladder import FULL, TOY, Ladder, trained
from benchmarks.paper.study import folder_of, form_of, simulate
from benchmarks.report import Page, Run, table
from learning.data.splits import make_split
from learning.metrics import r_squared
from recorder.processes import cores
from recorder.progress import span_of
from sim.dataset import DatasetPlan, Solving
from sim.indenters import NAMES
from sim.sensors import sensor

Floats = NDArray[np.float64]
SENSOR = "gelsight"
# Nets, of which `superposed` adds the forces of linear parts.
NETS = ("tiny", "displacement", "superposed")
# Share of the targets, and frames of a phase.
FRACTION, PHASE = 0.1, 4


def measure(run: Run) -> dict[str, Any]:
    """Train each net with each seed, and return R2 of frames within and outside, by net."""
    size, folder = TOY if run.quick else FULL, folder_of(run, "gauge-extrapolation")
    seeds = run.options.seeds[:1] if run.quick else run.options.seeds
    row = sensor(SENSOR)
    assert row.trajectory is not None
    plan = DatasetPlan(
        "targets",
        (row,),
        indenters=tuple(name for name in NAMES if name in size.seen + size.unseen),
        solving=Solving(tier="layer"),
        steps=size.phase if run.quick else PHASE,
        fraction=0.01 if run.quick else FRACTION,
    )
    path = folder / f"{SENSOR}.markers.zarr"
    archive = simulate(path, plan, "cpu", cores(), span_of(run.progress, 0, 0.4))
    split = make_split(archive, validation=0, new_press=0)
    device = torch.device(run.device)
    ladder = Ladder(folder, archive, split, device, max(1, cores() // 2), False, size, 0)
    true, indenters = ladder.true_forces(SENSOR)
    labels = archive[SENSOR].table["wrench"][split.rows(archive[SENSOR].table, "train"), :3]
    outside = ((true < labels.min(axis=0)) | (true > labels.max(axis=0))).any(axis=1)
    strongest = indenters == indenters[np.abs(true[:, 2]).argmax()]
    rows: dict[str, list[list[float]]] = {}
    for done, net in enumerate(NETS):
        for seed in seeds:
            presses = ladder.presses(SENSOR, "train", form_of(net))
            model = trained(replace(ladder, seed=seed), net, presses)
            predicted = model.predict(ladder.unseen(SENSOR, form_of(net)))
            parts = (np.ones(len(true), bool), ~outside, outside, ~strongest)
            rows.setdefault(net, []).append([_r2(true, predicted, part) for part in parts])
        run.progress(0.4 + 0.6 * (done + 1) / len(NETS))
    run.seeds, run.spread = seeds, "mean, with the smallest and largest of the seeds"
    return {"outside": float(outside.mean()), "strongest": str(indenters[strongest][0])} | {
        "rows": rows
    }


def section(values: dict[str, Any], page: Page) -> str:
    """Return the table."""
    lines = []
    for net, scores in values["rows"].items():
        cells = []
        for column in np.array(scores, np.float64).T:
            spread = f" ({column.min():.3f} to {column.max():.3f})" if len(column) > 1 else ""
            cells.append(f"{column.mean():.3f}{spread}")
        lines.append([f"`{net}`", *cells])
    head = ["net", "R2, all frames", "within", "outside", f"without `{values['strongest']}`"]
    return f"""## Forces beyond those of the training

Nets of own labels of `{SENSOR}`, by tier `layer`; {100 * values["outside"]:.1f} % of the frames of
unseen indenters have a force component that no training label reaches.

{table(head, lines)}"""


def _r2(true: Floats, predicted: Floats, rows: NDArray[np.bool_]) -> float:
    return float(r_squared(true[rows], predicted[rows]).mean()) if rows.sum() > 1 else float("nan")
