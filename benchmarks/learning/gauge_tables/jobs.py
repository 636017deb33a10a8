"""The jobs of the tables: each fits a twin, or trains nets of one seed, and writes scored cells.

A cell holds sums by test indenter, from which the page takes R2, errors and intervals. Methods that
are not privileged read no label of the target: neither in training nor to choose anything.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.learning.gauge_tables.skins import (
    GAUGE,
    GAUGE_PRESSES,
    GROUPS,
    name_of,
    planted,
    write_twin,
)
from benchmarks.learning.paper_chain.jobs import (
    Chain,
    Joined,
    archive_file,
    field_translator,
    form_of,
    nearest_labels,
    shortened,
    unseen_presses,
)
from benchmarks.learning.paper_chain.sizes import RECIPES
from benchmarks.learning.paper_chain.sizes import SIZES as CHAIN_SIZES
from benchmarks.learning.paper_chain.sizes import Size as ChainSize
from learning.compensation.fit import PairCompensation
from learning.compensation.simulated import simulated_labels, twin_forces
from learning.config import read_settings
from learning.data.presses import Presses, load_presses
from learning.data.splits import Split, make_split
from learning.errors import LearningError
from learning.experiment.frames import look_of, translate_presses
from learning.force.labels import Relabelling, by_twins, compensated
from learning.force.model import ForceModel
from learning.force.train import PRESETS, ForceModelSettings, train_force
from learning.metrics import r_squared
from learning.training.run import generator
from learning.translation.loading import load_translator
from learning.translation.translator import SensorView, for_pair
from recorder import MarkerArchive
from recorder.store import replace_file
from sim.dataset.plan import UNSEEN
from sim.indenters import NAMES
from sim.result import ContactTier
from tactile.run import main as run_sim

Floats = NDArray[np.float64]

# Labelled presses of the target that few-shot methods get.
SHOTS = (1, 5, 20)
# Overrides of presets; the others are the presets' own.
NETS = {
    "tiny": ("sequences.batch=8", "sequences.flips=true"),
    "displacement": ("sequences.flips=true",),
    "paper": RECIPES["paper"],
}
# R2 of the source's labels as the target's own, from which two sensors are the same.
SAME = 0.9999


@dataclass(frozen=True, slots=True)
class Size:
    """Data and trainings of one size."""

    sensors: int | None
    """Number of sensors of the group, the first ones; None: all."""
    tier: ContactTier
    """Tier of true forces and frames."""
    targets: int
    """Targets under each indenter."""
    phase: int
    """Frames of a phase of a press."""
    seen: tuple[str, ...]
    """Indenters that are trained on."""
    unseen: tuple[str, ...]
    """Indenters of the 18 that are tested."""
    drawn: int
    """Drawn indenters, which are tested."""
    further: tuple[int, int]
    """Further drawn indenters, on which intervals are calibrated, and on which they are tested."""
    grid: int
    """Pixels of twins and their labels."""
    draws: int
    """Sensors drawn from a twin: for the spread of its labels, and to train on."""
    steps: int
    """Steps of a net from nothing: `paper` has half of them, one that goes on a quarter."""
    nets: tuple[str, ...]
    """Nets that are trained on a sensor's own labels; the main one reads images."""
    chain: ChainSize
    """Settings of the field translator."""


SIZES = {
    "gpu": Size(
        sensors=None,
        tier="fem",
        targets=8,
        phase=4,
        seen=tuple(name for name in NAMES if name not in UNSEEN),
        unseen=UNSEEN,
        drawn=6,
        further=(40, 60),
        grid=48,
        draws=4,
        steps=1000,
        nets=("tiny", "displacement", "paper"),
        chain=replace(CHAIN_SIZES["heterogeneous"], held_out=()),
    ),
    "toy": Size(
        sensors=2,
        tier="layer",
        targets=2,
        phase=2,
        seen=("sphere", "prism"),
        unseen=("sphere_s",),
        drawn=2,
        further=(2, 2),
        grid=24,
        draws=1,
        steps=16,
        nets=("tiny", "displacement"),
        chain=replace(CHAIN_SIZES["toy"], held_out=(), compensated=True),
    ),
}
MAIN = "tiny"


@dataclass(frozen=True, eq=False)
class Study(Chain):
    """Surroundings of a job: those of the paper's chain, for planted sensors and one seed."""

    group: str = "heterogeneous"
    of: Size = SIZES["toy"]
    skins: int = 0
    """Seed of the planted sensors."""
    fit: ContactTier = "layer"
    """Tier of twins, their labels and draws."""

    @property
    def designs(self) -> tuple[str, ...]:
        """Designs of the sensors."""
        return GROUPS[self.group][: self.of.sensors]

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the planted sensors."""
        return tuple(map(name_of, self.designs))

    @property
    def cells(self) -> Path:
        """Folder of the scored cells."""
        return self.out / "cells"

    @cached_property
    def archive(self) -> MarkerArchive:
        """Frames of the sensors, with labels."""
        return Joined([archive_path(self.out, name) for name in self.sensors])

    @cached_property
    def split(self) -> Split:
        """Training presses under the seen ones of the 18 indenters; all others are tested."""
        drawn = [name for name in self.archive.indenters if name not in NAMES]
        unseen = [*UNSEEN, *drawn]
        return make_split(self.archive, validation=0, new_press=0, unseen=unseen)

    def model(self, name: str) -> Path:
        """Folder of a trained network of this seed."""
        return self.out / "models" / f"{name}-{self.seed}"


def archive_path(out: Path, name: str) -> Path:
    """Return the path of a sensor's archive."""
    return out / archive_file(name)


def further_path(out: Path, name: str) -> Path:
    """Return the path of a sensor's archive of further drawn indenters."""
    return archive_path(out / "further", name)


def twin_path(out: Path, name: str) -> Path:
    """Return the path of a sensor's twin."""
    return out / "twins" / f"{name}.yaml"


def draws_path(out: Path, name: str) -> Path:
    """Return the path of the archive of sensors that are drawn from a sensor's twin."""
    return archive_path(out / "draws", name)


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Forces that a method gives for the test frames of a target."""

    method: str
    net: str
    source: str
    target: str
    spent: int
    """Presses of the target with a gauge that the method needs."""
    privileged: bool
    """True if it learns from labels of the target."""
    force: Floats
    """Fx, Fy, Fz of the test frames (n, 3) [N]; NaN where the method gives none."""


def cell(study: Study, found: Prediction, *, partial: bool = False) -> dict[str, Any]:
    """Return the scores of a prediction: sums by indenter, in and out of the labels' range.

    A frame is out of range if one of its forces is beyond those of the target's training presses.

    Raises:
        LearningError: A force is not finite, and `partial` is False.
    """
    table = study.archive[found.target].table
    rows = unseen_presses(study, found.target).rows.numpy()
    true = table["wrench"][rows, :3].astype(np.float64)
    known = np.asarray(np.isfinite(found.force).all(axis=1), np.bool_)
    if not (partial or known.all()):
        raise LearningError(
            f"{found.method}, {found.source} to {found.target}: {int((~known).sum())} of "
            f"{len(known)} forces are not finite; allowed: none"
        )
    labels = table["wrench"][study.split.rows(table, "train"), :3]
    inside = ((true >= labels.min(axis=0)) & (true <= labels.max(axis=0))).all(axis=1)
    names = np.array(study.archive.indenters)[table["indenter"][rows]]
    sums = sums_of(true[known], found.force[known], names[known], inside[known])
    described = {
        name: getattr(found, name)
        for name in ("method", "net", "source", "target", "spent", "privileged")
    }
    return {**described, "seed": study.seed, "frames": int(known.sum()), "sums": sums}


def sums_of(
    true: Floats, found: Floats, indenter: NDArray[np.str_], inside: NDArray[np.bool_]
) -> dict[str, dict[str, list[list[float]]]]:
    """Return sums (5, 3) by indenter, `in` and `out` of range.

    Count, forces, their squares, squared and absolute errors.

    Args:
        true: Forces (n, 3) [N].
        found: Predicted forces (n, 3) [N].
        indenter: Name of each frame's indenter (n,).
        inside: True for frames in range (n,).
    """
    off = found - true
    parts = np.stack([np.ones_like(true), true, true**2, off**2, np.abs(off)], axis=1)
    return {
        str(name): {
            word: parts[(indenter == name) & of].sum(axis=0).tolist()
            for word, of in (("in", inside), ("out", ~inside))
        }
        for name in np.unique(indenter)
    }


def write_cells(study: Study, name: str, cells: Sequence[dict[str, Any]]) -> None:
    """Write the cells of a job, which replace those of an earlier run."""
    study.cells.mkdir(parents=True, exist_ok=True)
    lines = "".join(json.dumps(each) + "\n" for each in cells)
    replace_file(study.cells / f"{name.replace(' ', '-')}.jsonl", lines.encode())
    for each in cells:
        print(json.dumps({**each, "sums": "..."}), flush=True)


# Nets


def trained(
    study: Study,
    preset: str,
    presses: Presses | Sequence[Presses],
    start_from: ForceModel | None = None,
    compensation: Relabelling | None = None,
) -> ForceModel:
    """Return a force net, trained in memory for the steps of the size.

    Raises:
        LearningError: There is nothing to learn from, or the training diverged.
    """
    given = [f"seed={study.seed}", "patience_epochs=null", *NETS[preset]]
    if study.device.type == "cpu":
        given.append("launch.mixed_precision=no")
    found = read_settings(ForceModelSettings, PRESETS, preset, given)
    groups = [presses] if isinstance(presses, Presses) else presses
    if compensation is not None:
        groups = [compensation.of(each) for each in groups]
    count = sum(map(len, groups))
    parts = {"paper": 2} if start_from is None else {preset: 4}
    steps = study.of.steps // parts.get(preset, 1)
    epochs = max(1, round(steps / -(-count // found.sequences.batch)))
    stages = tuple(shortened(stage, epochs, count, found) for stage in found.stages[-1:])
    settings = replace(found, stages=stages)
    return train_force(groups, settings, start_from=start_from)


def by_curves(study: Study, source: str, target: str) -> PairCompensation | None:
    """Return the paper's compensation; None where a force-depth press has no solution."""
    assert study.compensation is not None
    if (source, target) in {(each.source, each.target) for each in study.compensation.pairs}:
        return study.relabelling(source, target)
    print(f"{source} to {target}: one has no force-depth curve", flush=True)
    return None


def baselines(study: Study) -> Iterator[tuple[Prediction, bool]]:
    """Yield predictions without nets, and whether some of their forces may be missing."""
    archive = study.archive
    for source, target in permutations(archive, 2):
        one, other = archive[source], archive[target]
        rows = unseen_presses(study, target).rows.numpy()
        train = one.table["wrench"][study.split.rows(one.table, "train"), :3]
        mean = np.tile(train.mean(axis=0), (len(rows), 1))
        yield Prediction("mean of the source's labels", "-", source, target, 0, False, mean), False
        partner = partners(one.table, other.table)[rows]
        wrench = one.table["wrench"][:, :3].astype(np.float64)
        known = [
            ("source's", 0, wrench),
            ("simulated", GAUGE_PRESSES, simulated_labels(one, other).force),
        ]
        relabelled = by_curves(study, source, target)
        if relabelled is not None:
            nearest = nearest_labels(study, source, target)
            yield Prediction("nearest frame", "-", source, target, 1, False, nearest), False
            valid = np.flatnonzero(one.table["valid"])
            priors = np.full_like(wrench, np.nan)
            priors[valid], _ = relabelled.applied(
                wrench[valid],
                one.table["depth"][valid].astype(np.float64),
                one.table["phase"][valid].astype(np.int64),
            )
            known.append(("priors", 1, priors))
        for word, spent, labels in known:
            force = np.where(partner[:, None] >= 0, labels[partner], np.nan)
            name = f"labels alone: {word}"
            yield Prediction(name, "-", source, target, spent, False, force), True
    for target in archive:
        rows = unseen_presses(study, target).rows.numpy()
        force = twin_forces(archive[target]).force[rows]
        name = "labels alone: the target's twin"
        yield Prediction(name, "-", target, target, GAUGE_PRESSES, False, force), True


def partners(source: Any, target: Any) -> NDArray[np.int64]:
    """Return for each row of the target the source's row of the same location and frame; or -1."""
    keys = []
    for table in (source, target):
        rows = np.flatnonzero(table["valid"] & (table["location"] >= 0))
        pair = [table[name][rows].astype(np.int64) for name in ("location", "frame")]
        keys.append((rows, pair[0] * 10_000 + pair[1]))
    (own, one), (others, other) = keys
    _, here, there = np.intersect1d(one, other, assume_unique=True, return_indices=True)
    found = np.full(len(target["location"]), -1, np.int64)
    found[others[there]] = own[here]
    return found


def require_unlike(study: Study) -> None:
    """Check that no two sensors have the same forces.

    Raises:
        LearningError: Two have.
    """
    for source, target in permutations(study.archive, 2):
        one, other = study.archive[source].table, study.archive[target].table
        partner = partners(one, other)
        rows = np.flatnonzero(partner >= 0)
        forces = (other["wrench"][rows, :3], one["wrench"][partner[rows], :3])
        same = float(r_squared(*(each.astype(np.float64) for each in forces)).mean())
        if same > SAME:
            raise LearningError(
                f"{source}, {target}: labels of either are those of the other (R2 {same:.5f}); "
                "allowed: sensors that differ"
            )


def from_source(study: Study, source: str) -> Iterator[Prediction]:
    """Yield predictions of nets that are trained on one source, for all targets."""
    archive = study.archive
    field = load_translator(study.model("field"), study.device)
    presses = {form: study.presses(source, "train", form) for form in ("images", "field", "packed")}
    begun = trained(study, MAIN, presses["images"])
    moved = trained(study, "displacement", presses["field"])
    for target in (name for name in archive if name != source):
        one, other = archive[source], archive[target]

        def of(
            method: str,
            net: str,
            model: ForceModel,
            spent: int,
            privileged: bool = False,
            target: str = target,
        ) -> Prediction:
            force = model.predict(unseen_presses(study, target, form_of(net)))
            return Prediction(method, net, source, target, spent, privileged, force)

        yield of("source-only", MAIN, begun, 0)
        yield of("source-only", "displacement", moved, 0)
        pair = for_pair(field, SensorView.of(one), SensorView.of(other))
        packed = presses["packed"]
        shown = translate_presses(packed, look_of(other, packed, study.device), pair)
        priors, simulated = by_curves(study, source, target), simulated_labels(one, other)
        for word, spent, labels in (
            ("priors", 1, None if priors is None else compensated(priors)),
            ("simulated", GAUGE_PRESSES, by_twins(simulated)),
        ):
            if labels is None:
                continue
            tuned = trained(study, "displacement", presses["field"], moved, labels)
            yield of(f"displacement, {word}", "displacement", tuned, spent)
            tuned = trained(study, MAIN, shown, begun, labels)
            yield of(f"field, {word}", MAIN, tuned, spent)
            if word == "priors":
                start = tuned
        if priors is None:
            continue
        labelled = compensated(priors).of(shown)
        for method, spent, rows in few_shots(study, target):
            few = load_presses(other, rows, device=study.device)
            # As many target presses as translated ones, each several times.
            often = max(1, len(labelled) // len(few))
            tuned = trained(study, MAIN, [labelled, *[few] * often], start)
            yield of(method, MAIN, tuned, spent, True)


def few_shots(study: Study, target: str) -> Iterator[tuple[str, int, NDArray[np.int64]]]:
    """Yield name, presses spent, and rows of labelled training presses of a target.

    Those spent include the force-depth press, with which labels are compensated.
    """
    table = study.archive[target].table
    rows = study.split.rows(table, "train")
    places = np.unique(table["location"][rows])
    order = generator(study.seed, "few-shot", target).permutation(len(places))
    for count in SHOTS:
        chosen = places[order[:count]]
        kept = rows[np.isin(table["location"][rows], chosen)]
        yield f"few-shot, {count}", len(chosen) + 1, kept
    gauge: list[int] = []
    for indenter in GAUGE:
        of_it = table["indenter"] == study.archive.indenters.index(indenter)
        chosen = places[order][np.isin(places[order], table["location"][of_it])]
        gauge += chosen[: GAUGE_PRESSES // len(GAUGE)].tolist()
    kept = rows[np.isin(table["location"][rows], gauge)]
    yield f"few-shot, {len(gauge)} of the gauge's indenters", len(gauge) + 1, kept


def own(study: Study, sensor: str) -> Iterator[Prediction]:
    """Yield predictions of nets that are trained on a sensor's frames alone.

    With its twin's forces as labels, and with its own.
    """
    labels = twin_forces(study.archive[sensor])
    for preset in study.of.nets:
        presses = study.presses(sensor, "train", form_of(preset))
        test = unseen_presses(study, sensor, form_of(preset))
        if preset != "paper":
            model = trained(study, preset, by_twins(labels).of(presses))
            force = model.predict(test)
            method = "own frames, the twin's forces"
            yield Prediction(method, preset, sensor, sensor, GAUGE_PRESSES, False, force)
        force = trained(study, preset, presses).predict(test)
        yield Prediction("own labels", preset, sensor, sensor, len(presses), True, force)


def from_draws(study: Study, sensor: str) -> Iterator[Prediction]:
    """Yield predictions of nets that are trained on sensors drawn from a twin alone."""
    drawn = MarkerArchive(draws_path(study.out, sensor))
    for preset in (MAIN, "displacement"):
        groups = []
        for each in drawn.values():
            rows = np.flatnonzero(each.table["valid"] & (each.table["location"] >= 0))
            how: dict[str, Any] = {"form": form_of(preset), "processes": study.processes}
            groups.append(load_presses(each, rows, device=study.device, **how))
        test = unseen_presses(study, sensor, form_of(preset))
        force = trained(study, preset, groups).predict(test)
        method = "draws of the twin, no other frame"
        yield Prediction(method, preset, sensor, sensor, GAUGE_PRESSES, False, force)


def names(study: Study, seeds: Sequence[int]) -> dict[str, tuple[str, ...]]:
    """Return the names of all jobs, the most urgent first, and those that each needs."""
    archives = tuple(f"archive {name}" for name in study.sensors)
    labels = tuple(f"labels {name}" for name in study.sensors)
    jobs: dict[str, tuple[str, ...]] = {name: () for name in archives}
    jobs |= {f"twin {name}": () for name in study.sensors}
    jobs |= {f"labels {name}": (f"archive {name}", f"twin {name}") for name in study.sensors}
    jobs |= {f"field {seed}": archives for seed in seeds}
    jobs |= {f"draws {name}": (f"twin {name}",) for name in study.sensors}
    jobs["baselines"] = labels
    jobs |= {f"further {name}": () for name in study.sensors}
    for name in study.sensors:
        jobs[f"further-labels {name}"] = (f"further {name}", f"twin {name}")
    for seed in seeds:
        jobs |= {f"own {name} {seed}": (*archives, f"labels {name}") for name in study.sensors}
        jobs |= {f"from {name} {seed}": (*labels, f"field {seed}") for name in study.sensors}
        for name in study.sensors:
            jobs[f"drawn {name} {seed}"] = (*archives, f"draws {name}")
            labelled = (*archives, f"labels {name}", f"further-labels {name}")
            jobs[f"coverage {name} {seed}"] = labelled
    return jobs


def run_job(study: Study, name: str) -> None:
    """Run a job by its name; archives and draws are commands of `sim`.

    Raises:
        LearningError: No label could be simulated.
    """
    kind, *rest = name.split()
    if kind == "twin":
        design = study.designs[study.sensors.index(rest[0])]
        each = planted(study.out / "rows", study.group, design, study.skins)
        device = "cuda:0" if study.device.type == "cuda" else "cpu"
        how: dict[str, Any] = {"truth": study.of.tier, "fit": study.fit, "device": device}
        how |= {"grid": study.of.grid, "processes": study.processes}
        write_twin(each, twin_path(study.out, rest[0]), **how)
    elif kind in ("labels", "further-labels"):
        archive = (archive_path if kind == "labels" else further_path)(study.out, rest[0])
        twin = twin_path(study.out, rest[0])
        words = ["sim", "labels", str(archive), "--sensor", rest[0], "--twin", str(twin)]
        words += ["--draws", str(study.of.draws), "--grid", str(study.of.grid)]
        words += ["--processes", str(study.processes)]
        words += ["--device", "cuda:0" if study.device.type == "cuda" else "cpu"]
        if code := run_sim(words):
            raise LearningError(f"{name}: ended with code {code}; allowed: 0")
    elif kind == "field":
        field_translator(replace(study, seed=int(rest[0])))
    elif kind == "baselines":
        require_unlike(study)
        write_cells(study, name, [cell(study, found, partial=p) for found, p in baselines(study)])
    else:
        of_seed = replace(study, seed=int(rest[1]))
        kinds = {"own": own, "from": from_source, "drawn": from_draws}
        found = kinds[kind](of_seed, rest[0])
        write_cells(of_seed, name, [cell(of_seed, each) for each in found])
