"""Ways to the forces of a sensor, from the weakest to the strongest, on planted sensors.

A cell has sums of errors by test indenter of one seed, source and target. Only ways that are
privileged read labels of the target, in training or to choose anything.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.gauge.planted import GROUPS, SEED, Planted, planted, twin_of
from benchmarks.paper.study import (
    PAPER_RECIPE,
    Joined,
    Study,
    folder_of,
    forces_by_curves,
    form_of,
    nearest_labels,
    net_settings,
    processes,
    quick_row,
    simulate,
    train_net,
)
from benchmarks.report import Run
from benchmarks.sums import RESAMPLES, interval, r2_of, resampled, sums_by_indenter
from benchmarks.twin.planted import Truth
from learning.compensation.simulated import simulated_labels, twin_forces
from learning.data.presses import Presses
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.force.labels import Relabelling, by_twins
from learning.force.model import ForceModel
from learning.training.run import generator
from recorder import MarkerArchive
from recorder.archive import write_simulated
from recorder.progress import span_of
from recorder.store import replace_file
from sim.dataset import DatasetPlan, Solving
from sim.dataset.plan import UNSEEN
from sim.indenters import NAMES, drawn_name
from sim.sensors import sensor_of
from sim.twin.labels import provenance, simulated_forces

Floats = NDArray[np.float64]
# Overrides of presets; the others are the presets' own.
NETS = {
    "tiny": ("sequences.batch=8", "sequences.flips=true"),
    "displacement": ("sequences.flips=true",),
    "paper": PAPER_RECIPE,
}
MAIN = "tiny"
# Names of the ways, in their order; labels at true places are no predictions from frames.
MEAN, NEAREST, SOURCE = "mean of the source's labels", "nearest frame", "source only"
DISPLACED, TRANSLATED = "displacement", "translation"
BY_TWIN, OWN = "own frames, the twin's forces", "own labels"
AT_PLACES = ("the source's labels", "labels by curves", "labels by both twins", "the twin's forces")
# Presses of the target with a gauge: a force-depth curve, and those of a twin's fit.
CURVE, TWIN = 1, 4
# Draws from a twin's uncertainty, for the spread of its labels; pixels of twins and labels.
DRAWS, GRID = 4, 48
# Steps of a net from nothing: `paper` has half of them, one that goes on a quarter. Training time
# of the field translator [s].
STEPS, FIELD_SECONDS = 1000, 60


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Forces that a way gives for the test frames of a target."""

    way: str
    net: str
    source: str
    target: str
    spent: int
    """Presses of the target with a gauge that it needs."""
    force: Floats
    """Fx, Fy, Fz of the test frames (n, 3) [N]; NaN where there is none."""


def measure(group: str, run: Run) -> dict[str, Any]:
    """Plant a group's sensors, fit their twins, train every way, and return the table's lines."""
    seeds = run.options.seeds[: 1 if run.quick else None]
    study = prepare(run, folder_of(run, f"gauge-{group}"), group)
    cells = list(run.once("baselines", lambda: [cell(study, one) for one in baselines(study)]))
    ways: dict[str, Way] = {"own": own, "from": from_source}
    for done, seed in enumerate(seeds):
        run.progress(0.5 + 0.5 * done / len(seeds))
        of_seed = replace(study, seed=seed)
        for name, sensor in product(ways, study.archive):

            def job(name: str = name, sensor: str = sensor, one: Study = of_seed) -> Any:
                return [cell(one, each) for each in ways[name](one, sensor)]

            cells += run.once(f"{name} {sensor} {seed}", job)
    run.seeds = seeds
    run.spread = "means of pairs and seeds; 95 % intervals by drawing indenters and seeds again"
    return {
        "designs": GROUPS[group][: len(study.archive)],
        "skins": SEED,
        "fit": run.options.fit,
        "truth": "layer" if run.quick else "fem",
        "lines": lines_of(cells),
        "twins": {}
        if run.quick
        else {name: run.rows[f"twin {name}"]["errors"] for name in study.archive},
    }


def prepare(run: Run, folder: Path, group: str) -> Study:
    """Return the sensors' frames with true forces and those of their twins.

    A quick run has two sensors by tier `layer`, under three indenters.
    """
    sensors, indenters, targets, phase, drawn = None, NAMES, 8, 4, 6
    if run.quick:
        sensors, indenters, targets, phase, drawn = 2, ("sphere_s", "prism"), 1, 2, 1
    solving = Solving(tier="layer" if run.quick else "fem")
    designs = GROUPS[group][:sensors]
    tested = [drawn_name(number) for number in range(drawn)]
    paths = []
    for done, design in enumerate(designs):
        progress = span_of(run.progress, 0.5 * done / len(designs), 0.5 / len(designs))
        one = planted(folder, group, design)
        assert one.row.trajectory is not None
        plan = DatasetPlan(
            "targets",
            (quick_row(one.row) if run.quick else one.row,),
            indenters=(*indenters, *tested),
            solving=solving,
            steps=phase,
            fraction=round(targets / len(one.row.trajectory), 6),
        )
        paths.append(folder / f"{one.row.name}.markers.zarr")
        archive = simulate(paths[-1], plan, run, span_of(progress, 0, 0.5))
        add_labels(archive, one, folder, run)
        progress(1.0)
    archives = Joined(paths)
    split = make_split(archives, validation=0, new_press=0, unseen=[*UNSEEN, *tested])
    seconds = 0 if run.quick else FIELD_SECONDS
    device = torch.device(run.device)
    return Study(archives, split, device, quick=run.quick, field_seconds=seconds)


def add_labels(archive: MarkerArchive, one: Planted, folder: Path, run: Run) -> None:
    """Add the forces of a sensor's twin to its presses, unless they are there.

    In a quick run the design stands for the twin, which saves the fit.
    """
    name, twin, draws, grid = one.row.name, one.design, 0, 16
    if not run.quick:
        twin, draws, grid = str(folder / f"{name}-twin.yaml"), DRAWS, GRID
        # True forces are those of `fem`.
        fit = partial(twin_of, one, Truth("fem", device=run.device), run.options.fit, grid)
        replace_file(Path(twin), run.once(f"twin {name}", fit)["row"].encode())
    sensor, row = archive[name], sensor_of(twin)
    source = provenance(row, draws, 0, grid, None)
    if sensor.simulated is not None and sensor.simulated.made_from == source:
        return
    how: dict[str, Any] = {"draws": draws, "seed": 0, "grid": grid, "device": run.device}
    forces = simulated_forces(sensor, archive.indenters, row, processes=processes(run), **how)
    write_simulated(sensor, forces.force, forces.spread, source)


def partners(source: Any, target: Any) -> NDArray[np.int64]:
    """Return for each row of the target the source's row of the same location and frame; or -1."""
    partner, of_source = np.full(len(target["location"]), -1, np.int64), _places(source)
    for place, row in _places(target).items():
        partner[row] = of_source.get(place, -1)
    return partner


def _places(table: Any) -> dict[tuple[int, int], int]:
    rows = np.flatnonzero(table["valid"] & (table["location"] >= 0)).tolist()
    return {(int(table["location"][row]), int(table["frame"][row])): row for row in rows}


# Ways

Way = Callable[[Study, str], Iterator[Prediction]]


def trained(
    study: Study,
    preset: str,
    presses: Presses,
    start_from: ForceModel | None = None,
    labels: Relabelling | None = None,
) -> ForceModel:
    """Return a force net, trained in memory; LearningError if it cannot learn or diverges."""
    settings = net_settings(study, preset, NETS[preset])
    parts = {"paper": 2} if start_from is None else {preset: 4}
    steps = 2 if study.quick else STEPS // parts.get(preset, 1)
    epochs = max(1, round(steps / -(-len(presses) // settings.sequences.batch)))
    return train_net(presses, settings, settings.stages[-1:], epochs, start_from, labels)


def baselines(study: Study) -> Iterator[Prediction]:
    """Yield predictions without nets."""
    archive = study.archive
    for source, target in permutations(archive, 2):
        one, other = archive[source], archive[target]
        rows = study.unseen(target).rows.numpy()
        train = one.table["wrench"][study.split.rows(one.table, "train"), :3]
        mean = np.tile(train.mean(axis=0, dtype=np.float64), (len(rows), 1))
        yield Prediction(MEAN, "-", source, target, 0, mean)
        wrench = one.table["wrench"][:, :3].astype(np.float64)
        both = simulated_labels(one, other).force
        labels = [(AT_PLACES[0], 0, wrench), (AT_PLACES[2], TWIN, both)]
        if study.curves(source, target) is not None:
            nearest = nearest_labels(study, source, target)
            yield Prediction(NEAREST, "-", source, target, CURVE, nearest)
            valid = np.flatnonzero(one.table["valid"])
            scaled = np.full_like(wrench, np.nan)
            scaled[valid] = forces_by_curves(study, source, target, valid)
            labels.append((AT_PLACES[1], CURVE, scaled))
        partner = partners(one.table, other.table)[rows]
        for words, spent, forces in labels:
            force = np.where(partner[:, None] >= 0, forces[partner], np.nan)
            yield Prediction(words, "-", source, target, spent, force)
    for target in archive:
        force = twin_forces(archive[target]).force[study.unseen(target).rows.numpy()]
        yield Prediction(AT_PLACES[3], "-", target, target, TWIN, force)


def from_source(study: Study, source: str) -> Iterator[Prediction]:
    """Yield predictions of nets that are trained on one source, for all targets."""
    archive = study.archive
    images, moved, packed = (
        study.presses(source, "train", form) for form in ("images", "field", "packed")
    )
    nets = {MAIN: trained(study, MAIN, images)}
    nets["displacement"] = trained(study, "displacement", moved)
    for target in (each for each in archive if each != source):
        one, other = archive[source], archive[target]

        def of(way: str, net: str, model: ForceModel, spent: int, to: str = target) -> Prediction:
            force = model.predict(study.unseen(to, form_of(net)))
            return Prediction(way, net, source, to, spent, force)

        yield of(SOURCE, MAIN, nets[MAIN], 0)
        yield of(DISPLACED, "displacement", nets["displacement"], 0)
        frames = study.translated(study.field, packed, target)
        for words, spent, labels in (
            (AT_PLACES[1], CURVE, study.curves(source, target)),
            (AT_PLACES[2], TWIN, by_twins(simulated_labels(one, other))),
        ):
            if labels is not None:
                tuned = trained(study, "displacement", moved, nets["displacement"], labels)
                yield of(f"{DISPLACED}, {words}", "displacement", tuned, spent)
                tuned = trained(study, MAIN, frames, nets[MAIN], labels)
                yield of(f"{TRANSLATED}, {words}", MAIN, tuned, spent)


def own(study: Study, sensor: str) -> Iterator[Prediction]:
    """Yield predictions of nets that are trained on a sensor's frames alone.

    With its twin's forces as labels, and with its own.
    """
    labels = by_twins(twin_forces(study.archive[sensor]))
    for preset in [MAIN, "displacement"] if study.quick else NETS:
        presses = study.presses(sensor, "train", form_of(preset))
        test = study.unseen(sensor, form_of(preset))
        if preset != "paper":
            force = trained(study, preset, presses, labels=labels).predict(test)
            yield Prediction(BY_TWIN, preset, sensor, sensor, TWIN, force)
        force = trained(study, preset, presses).predict(test)
        yield Prediction(OWN, preset, sensor, sensor, len(presses), force)


# Scores


def cell(study: Study, one: Prediction) -> dict[str, Any]:
    """Return a prediction's sums by indenter; LearningError if a force of a net is not finite."""
    true, names = study.true_forces(one.target)
    finite = np.isfinite(one.force).all(axis=1)
    if one.net != "-" and not finite.all():
        raise LearningError(f"{one.way}, {one.source} to {one.target}: forces are not finite")
    sums = sums_by_indenter(true[finite], one.force[finite], names[finite])
    described = {name: getattr(one, name) for name in ("way", "net", "source", "target", "spent")}
    return described | {"seed": study.seed, "sums": sums}


def lines_of(cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a line for each way and net: R2 with intervals, and how far it is below own labels.

    Sealed are drawn indenters; the paper's six stand apart.
    """
    scored = []
    for way, net in dict.fromkeys((each["way"], each["net"]) for each in cells):
        these = [each for each in cells if (each["way"], each["net"]) == (way, net)]
        seeds = sorted({each["seed"] for each in these})
        by_seed = {(each["seed"], each["source"], each["target"]): each["sums"] for each in these}
        # A pair that lacks a seed would count for less.
        ends = dict.fromkeys((each["source"], each["target"]) for each in these)
        pairs = [end for end in ends if all((seed, *end) in by_seed for seed in seeds)]
        if not pairs:
            continue
        grid = [[by_seed[seed, *end] for end in pairs] for seed in seeds]
        sealed = sums_of(grid, lambda name: name not in UNSEEN)
        total = sealed.sum(axis=2)
        errors = np.nanmean(total[..., 4, :] / np.maximum(total[..., 0, :], 1), axis=(0, 1))
        line = {
            "way": way,
            "net": net,
            "spent": max(each["spent"] for each in these),
            "pairs": len(pairs),
            "mae_shear_n": float(errors[:2].mean()),
            "mae_fz_n": float(errors[2]),
        }
        paper = scores_of(sums_of(grid, lambda name: name in UNSEEN))
        scored.append((line, scores_of(sealed), paper))
    owned = [sealed for line, sealed, _ in scored if line["way"] == OWN and np.isfinite(sealed[0])]
    best = max(owned, key=lambda sealed: float(sealed[0]), default=np.full(1 + RESAMPLES, np.nan))
    for line, sealed, paper in scored:
        for name, values in (("sealed", sealed), ("paper", paper), ("below", best - sealed)):
            low, high = interval(values[1:])
            line |= {name: float(values[0]), f"{name}_low": float(low), f"{name}_high": float(high)}
    return [line for line, _, _ in scored]


def sums_of(grid: Sequence[Sequence[Mapping[str, Any]]], of: Callable[[str], bool]) -> Floats:
    """Return sums by seed, pair and indenter (s, p, k, 5, 3)."""
    names = sorted({name for row in grid for sums in row for name in sums if of(name)})
    none = np.zeros((5, 3))
    parts = [[[sums.get(name, none) for name in names] for sums in row] for row in grid]
    return np.array(parts, np.float64).reshape(len(grid), len(grid[0]), len(names), 5, 3)


def scores_of(sums: Floats) -> Floats:
    """Return the mean R2 over seeds and pairs, then that of each resample (1 + RESAMPLES,).

    Indenters of `sums_of` are drawn again, the same for all pairs, and so are seeds.
    """
    if not sums.shape[2]:
        return np.full(1 + RESAMPLES, np.nan)
    random = generator(0, "resamples")
    drawn = resampled(sums, random).mean(axis=2)
    chosen = random.integers(len(sums), size=(RESAMPLES, len(sums)))
    again = np.take_along_axis(drawn, chosen, axis=1).mean(axis=1)
    return np.append(r2_of(sums.sum(axis=2)).mean(), again)
