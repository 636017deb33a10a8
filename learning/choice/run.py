"""`tactile force`: ways to a sensor's labels are compared, and the chosen one is delivered."""

import functools
import hashlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.choice.candidates import Candidate, candidates_of, of_plugin, with_codes
from learning.choice.nested import FEWEST, Choice, Fold, Labelled, choose, contained
from learning.config import require_same
from learning.data.matching import SensorSelection
from learning.data.presses import Form, Presses, load_presses
from learning.errors import LearningError
from learning.evaluation.predictions import TARGET
from learning.force.calibrate import IntervalCalibration, largest, scale_of_twin, shapes
from learning.force.intervals import FEWEST as FEWEST_ERRORS
from learning.force.intervals import (
    FEWEST_INDENTERS,
    AxisError,
    Intervals,
    LearnedShapes,
    Scale,
    both,
    fit_errors,
    learned_within,
)
from learning.force.labels import TWIN, LabelSource, Relabelling, label_source
from learning.force.made_for import CHOICE, metadata_of
from learning.force.model import AXES, KIND, ForceModel
from learning.metrics import axis_means
from learning.plugins import plugin_names
from learning.training.checkpoint import CONFIG, MODEL, Config, code_version
from learning.transfer.carry import Carried
from learning.transfer.deliver import CARD, calibration_picture, scale_line, write_model
from recorder.archive import archive_fingerprint
from recorder.pages import render
from recorder.progress import ItemProgress
from recorder.store import replace_file

Floats = NDArray[np.float64]
Say = Callable[[str], None]
# Picture in the folder of the model; folder of what was learned on the way.
PICTURE, STEPS = "forces.png", "steps"


@dataclass(frozen=True, slots=True)
class Request:
    """A sensor whose forces are wanted, and where its model goes."""

    sensor: SensorSelection
    out: Path
    source: SensorSelection | None = None
    """Another sensor with labels, from which nets may start."""
    ways: tuple[str, ...] | None = None
    """Names of the ways to compare; None: all."""
    unseen: tuple[str, ...] | None = None
    """Indenters that no stage uses; None: as in the archive."""
    seed: int = 0
    device: str = "cpu"


@dataclass(frozen=True, slots=True, eq=False)
class Origin:
    """Labels of the sensor's frames, the scale that they have, and where they come from."""

    labels: LabelSource
    scale: Scale
    errors_from: str = "its own labels"
    method: str = TARGET
    """Method of evaluations that such a model has."""
    source: str = ""
    """Sensor of the labels, if it is another one."""
    error: AxisError | None = None
    """Error of the labels' Fz themselves, which models do not see; None: none."""
    notes: tuple[str, ...] = ()
    """Sentences about the labels, for the card."""


def own_labels(one: Request, csv: Path | None) -> Origin:
    """Return the labels of the sensor's archive, or of a CSV."""
    name = None if csv is None else str(csv)
    labels = label_source(name, one.sensor.archive, [one.sensor.sensor])
    return Origin(labels, Scale(1.0, "its labels are taken as true", assumed=False))


def twin_labels(one: Request) -> Origin:
    """Return the forces of the sensor's twin as labels."""
    labels = label_source(TWIN, one.sensor.archive, [one.sensor.sensor])
    rows = labelled_rows(one, labels)
    scale = scale_of_twin(one.sensor.archived, rows)
    return Origin(labels, scale, f"forces of {labels.data[0]}")


def carried_labels(matched: Carried, source: str) -> Origin:
    """Return the labels that another sensor has at the same places."""
    forces = matched.forces
    digest = hashlib.sha256(forces.tobytes()).hexdigest()
    labels = LabelSource(Relabelling(lambda rows, *_: forces[rows]), (matched.method, digest))
    text = f"{source}'s labels at the same place"
    return Origin(labels, matched.scale, text, matched.method, source)


def labelled_rows(one: Request, labels: LabelSource) -> NDArray[np.int64]:
    """Return the rows of all presses of usable indenters that have a label (n,)."""
    archive, table = one.sensor.archive, one.sensor.archived.table
    names = archive.indenters
    if unknown := sorted(set(one.unseen or ()) - set(names)):
        raise LearningError(f"--unseen: found {', '.join(unknown)}; allowed: {', '.join(names)}")
    if len(set(names)) < len(names):
        raise LearningError(f"{archive.name}: found an indenter twice in {', '.join(names)}")
    usable = table["valid"] & (table["location"] >= 0)
    if one.unseen is None:
        usable &= table["seen"]
    else:
        usable &= ~np.isin(np.array(names)[table["indenter"]], one.unseen)
    rows = np.flatnonzero(usable)
    own = labels.relabelling
    forces = table["wrench"][rows, :3] if own is None else own.at(table, rows)
    pressed = np.unique(table["location"][rows[np.isfinite(forces).any(axis=1)]])
    return rows[np.isin(table["location"][rows], pressed)]


def indenters_labelled(one: Request, labels: LabelSource) -> int:
    """Return the number of indenters under which the sensor has labels."""
    rows = labelled_rows(one, labels)
    return len(np.unique(one.sensor.archived.table["indenter"][rows]))


def run_choice(one: Request, origin: Origin, say: Say = print) -> Intervals:
    """Compare the ways, train the chosen one, and write its folder; continue what was stopped.

    Raises:
        LearningError: Labels on fewer than two indenters, or other data than the folder begins
            with.
    """
    archive, source = one.sensor.archive, origin.labels
    rows = labelled_rows(one, source)
    steps = one.out / STEPS
    if (one.out / CONFIG).exists() and not (steps / "choice.json").exists():
        raise LearningError(f"--out: found another model in {one.out}; allowed: a new folder")
    steps.mkdir(parents=True, exist_ok=True)
    data = " ".join([archive_fingerprint(archive), one.sensor.sensor, *source.data])
    require_same(
        steps / "choice.json",
        {
            "data": data,
            "source": one.source
            and f"{archive_fingerprint(one.source.archive)} {one.source.sensor}",
            "unseen": one.unseen and sorted(one.unseen),
            "seed": one.seed,
        },
    )
    ways = _ways(one)
    frames = {
        form: source.of(_loaded(one, one.sensor, rows, form)) for form in {way.form for way in ways}
    }
    presses = next(iter(frames.values()))
    labels = Labelled(
        presses.wrench[:, :3].double().cpu().numpy(), presses.indenter[presses.of_frame].numpy()
    )
    with ItemProgress("trainings", sys.stderr) as progress:
        choice = choose(
            ways, frames, labels, seed=one.seed, kept=steps / "left-out", progress=progress
        )
    names = archive.indenters
    table = [*table_of(choice, ways, labels, names)]
    say("\n".join(f"{way:10s} {mean:7.3f}  {worst}" for way, _, mean, worst in table))
    chosen = next(way for way in ways if way.name == choice.name)
    calibration = _calibrated(one, origin, presses, labels, choice)
    say(f"chosen: {chosen.name} ({chosen.about}), trained on all {len(labels.codes)} indenters")
    with ItemProgress(f"training {chosen.name}", sys.stderr) as progress:
        progress(0, 1)
        model = chosen.train(frames[chosen.form], one.seed, frozenset())
    lines = [*lines_of(choice, labels, calibration.intervals, names), *origin.notes]
    card = {"table": table, "lines": lines, "scale": scale_line(origin.scale)}
    settings = chosen.settings(model, one.seed, frames[chosen.form])
    _write(one, origin, data, chosen, model, settings, rows, calibration, card)
    for line in (*lines, scale_line(origin.scale)):
        say(line)
    return calibration.intervals


def _ways(one: Request) -> list[Candidate]:
    ways = candidates_of(one.sensor.archived)
    if one.source is not None:
        source = functools.cache(functools.partial(_presses_of_source, one, one.source))
        ways = candidates_of(one.sensor.archived, one.source.sensor, source)
    known, offered = [way.name for way in ways], plugin_names()
    more = [name for name in one.ways or () if name not in known]
    if unknown := sorted(set(more) - set(offered)):
        raise LearningError(
            f"--ways: found {', '.join(unknown)}; allowed: {', '.join([*known, *offered])}"
        )
    own = [way for way in ways if one.ways is None or way.name in one.ways]
    return [*own, *map(of_plugin, more)]


def _presses_of_source(one: Request, source: SensorSelection) -> Presses:
    """Return the labelled marker fields of another sensor, with the indenter codes of this one."""
    table, names = source.archived.table, source.archive.indenters
    usable = table["valid"] & (table["location"] >= 0) & table["seen"]
    usable &= ~np.isin(np.array(names)[table["indenter"]], one.unseen or ())
    return with_codes(
        _loaded(one, source, np.flatnonzero(usable), "field"), names, one.sensor.archive.indenters
    )


def _loaded(one: Request, of: SensorSelection, rows: NDArray[np.int64], form: Form) -> Presses:
    with ItemProgress(f"frames of {of.sensor} as {form}", sys.stderr) as progress:
        return load_presses(of.archived, rows, device=one.device, form=form, progress=progress)


def _calibrated(
    one: Request, origin: Origin, presses: Presses, labels: Labelled, choice: Choice
) -> IntervalCalibration:
    """Return the intervals of the chosen way, by its errors on indenters that were left out."""
    names = np.array(one.sensor.archive.indenters)[labels.indenter]
    seen = shapes(one.sensor.archived, presses.rows.numpy())
    known = np.isfinite(labels.forces).any(axis=1)
    axes = fit_errors(choice.left_out, labels.forces, names)
    if all(axis is None for axis in axes):
        raise LearningError(
            f"labels: found on {known.sum()} frames; allowed: {FEWEST_ERRORS} or more of an axis, "
            "as intervals need them"
        )
    intervals = Intervals(
        axes=(axes[0], axes[1], both(axes[2], origin.error)),
        scale=origin.scale,
        largest=largest(labels.forces),
        learned=_learned(seen, labels.indenter, [fold for fold, _ in choice.by_fold]),
        frames=int(known.sum()),
        indenters=tuple(sorted(set(names.tolist()))),
        errors_from=f"{origin.errors_from}, each indenter left out",
    )
    return IntervalCalibration(
        intervals, choice.left_out[known], labels.forces[known], names[known]
    )


def _learned(values: Floats, indenter: NDArray[np.int64], folds: list[Fold]) -> LearnedShapes:
    """Return the learned shapes (n, 7), with the limit that frames of left-out folds set."""
    held = [np.isin(indenter, sorted(fold)) for fold in folds]
    return learned_within(values, [(values[~out], values[out]) for out in held])


# Results: table, lines, folder.


def table_of(
    choice: Choice, ways: list[Candidate], labels: Labelled, names: tuple[str, ...]
) -> Iterator[tuple[str, str, float, str]]:
    """Yield the name of each way, its words, its score left out, and the worst indenter's."""
    for way in ways:
        errors = choice.errors.get(way.name)
        if errors is None:
            continue
        worst = int(np.nanargmax(errors))
        text = f"worst {names[labels.codes[worst]]} {1 - errors[worst]:.3f}"
        yield way.name, way.about, float(1 - axis_means(errors[:, None])[0]), text


def guaranteed(choice: Choice, labels: Labelled, axes: Sequence[AxisError | None]) -> float:
    """Return the share of forces of a new indenter that intervals contain for certain, on average.

    Of k indenters that were left out and a new one any may be the worst: of the new one's forces,
    k / (k + 1) times the part that the intervals contain of the others are sure to be within.
    """
    inside = contained(axes, choice.left_out, labels.forces)
    count = len(labels.codes)
    return (
        count
        / (count + 1)
        * float(np.nanmean([_mean(inside[labels.indenter == code]) for code in labels.codes]))
    )


def coverage(choice: Choice, labels: Labelled, names: tuple[str, ...]) -> Iterator[str]:
    """Yield the part of labels within their intervals by third of the force and worst indenter."""
    size = np.sqrt(np.nansum(np.square(labels.forces), axis=1))
    thirds = np.searchsorted(np.quantile(size, (1 / 3, 2 / 3)), size)
    for third, word in enumerate(("light", "middle", "strong")):
        yield f"{100 * _mean(choice.covered[thirds == third]):.0f} % of {word} forces"
    of = {code: _mean(choice.covered[labels.indenter == code]) for code in labels.codes}
    worst = min(of, key=of.__getitem__)
    yield f"{100 * of[worst]:.0f} % of {names[worst]}, the least"


def _mean(covered: Floats) -> float:
    return float(axis_means(covered.reshape(-1, 1))[0])


def lines_of(
    choice: Choice, labels: Labelled, intervals: Intervals, names: tuple[str, ...]
) -> Iterator[str]:
    """Yield the lines to print: R2 of the nested choice, errors, coverage and its guarantee."""
    fits = labels.fits(choice.nested)
    by_axis = axis_means(fits)
    shown = "  ".join(
        f"{axis} {fit:.3f}" for axis, fit in zip(AXES, by_axis, strict=True) if np.isfinite(fit)
    )
    each = ", ".join(
        f"{names[code]} {axis_means(row[:, None])[0]:.2f}"
        for code, row in zip(labels.codes, fits, strict=True)
    )
    yield f"R2 on indenters left out: {shown} ({each})"
    yield f"90 % intervals contain {', '.join(coverage(choice, labels, names))}"
    if len(labels.codes) >= FEWEST:
        by = ", ".join(sorted({way for _, way in choice.by_fold}))
        yield f"each was left out of choice ({by}), training and calibration"
    else:
        yield f"labels on {len(labels.codes)} indenters: the way is fixed, none is left to choose"
    off = np.abs(choice.nested - labels.forces)
    covered = 100 * axis_means(choice.covered)
    for axis, error in enumerate(intervals.axes):
        if error is not None:
            yield (
                f"{AXES[axis]}: off by {np.nanmean(off[:, axis]):.3f} N in the mean; interval +- "
                f"{error.base:.3f} N +- {100 * error.slope:.1f} % of the force, contained "
                f"{covered[axis]:.0f} %"
            )
    if len(labels.codes) < FEWEST_INDENTERS:
        level = 100 * guaranteed(choice, labels, intervals.axes)
        yield (
            f"90 % not guaranteed: {len(labels.codes)} indenters are fewer than "
            f"{FEWEST_INDENTERS}; {level:.0f} % are, of a new indenter like these"
        )


def _write(
    one: Request,
    origin: Origin,
    data: str,
    way: Candidate,
    model: ForceModel,
    settings: dict[str, Any],
    rows: NDArray[np.int64],
    calibration: IntervalCalibration,
    card: dict[str, Any],
) -> None:
    """Write the folder of the model; its weights come last."""
    archive, out = one.sensor.archive, one.out
    seen = list(calibration.intervals.indenters)
    metadata = {
        **metadata_of(archive, {one.sensor.sensor: rows}),
        "method": origin.method,
        CHOICE: {
            **{"way": way.name, "about": way.about, "seen": seen, "source": origin.source},
            "finger": str(one.sensor.archived.attrs.get("finger", "")),
        },
    }
    for name in ("model.onnx", f"{MODEL}.safetensors"):
        (out / name).unlink(missing_ok=True)
    replace_file(out / PICTURE, calibration_picture(calibration))
    text = functools.partial(
        render,
        Path(__file__).with_name(CARD),
        sensor=one.sensor.sensor,
        way=way,
        intervals=calibration.intervals,
        archive=archive.name,
        seed=one.seed,
        **card,
    )
    config = Config(KIND, settings, data, code_version(), metadata, step=0)
    write_model(out, config, model, calibration.intervals, lambda d: text(difference=d))
