"""Compensation of all pairs of an archive: priors, choices, and the JSON file that stores them."""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.compensation.prior import (
    DEFAULT_D0,
    DEFAULT_WEIGHT,
    Branch,
    ForceDepthCurve,
    Prior,
    compensate,
    curve_of_session,
    curve_of_table,
    fit_prior,
    prior_of_coefficients,
)
from learning.compensation.search import (
    D0_MM,
    D0_SHARES,
    Choice,
    PairedLabels,
    best_for_labels,
    best_for_priors,
    depth_range,
    paired_labels,
    scored_choice,
)
from learning.compensation.simulated import simulated_r2
from learning.config import READER, read_json
from learning.data.genforce.format import Compensation, read_compensation
from learning.errors import LearningError
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor
from recorder.charts import chart
from recorder.progress import ItemProgress
from recorder.store import replace_file

FORMAT, FORMAT_VERSION = "tactile-rig compensation", 1
# Names of choices: fixed; by the fit of the priors; by the target's labels.
CHOICES = ("default", "priors", "oracle")
# Choices that models are trained by, by their method in evaluations.
CHOICE_OF_METHOD = {"compensated": "default", "priors": "priors", "oracle": "oracle"}
CRITERIA = {
    "default": "d0 0, lambda 0.75, whatever the sensors",
    "priors": "least expected error of the compensated force-depth curve, from the fits' residuals",
    "oracle": "least mean distance between compensated labels and the target's own at paired "
    "locations of training presses [N]",
}
UNITS = "d0: fraction of the source's depth range; depths m; forces, errors and residuals N"


@dataclass(frozen=True, slots=True)
class PairCompensation:
    """Compensation of the labels of one sensor for another; applied by `learning.force.labels`."""

    source: Prior
    target: Prior
    d0: float
    """Fraction of the source's depth range below which labels are unchanged."""
    weight: float
    """Lambda."""

    def applied(
        self, wrench: NDArray[np.floating], depth: NDArray[np.float64], phase: NDArray[np.integer]
    ) -> tuple[NDArray[np.float64], int]:
        """Return compensated labels (n, 3) or (n, 6), and the number that were clamped."""
        return compensate(wrench, depth, phase, self.source, self.target, self.d0, self.weight)


@dataclass(frozen=True, slots=True)
class StoredPair:
    """Choices for one directed pair of sensors."""

    source: str
    target: str
    before: Choice
    """Errors without compensation."""
    choices: dict[str, Choice]
    """By the names of `CHOICES`; choices that could not be made are missing."""
    pairs: int = 0
    """Number of location pairs that errors are computed from."""


@dataclass(frozen=True, slots=True)
class StoredCompensation:
    """Result of `tactile compensate`."""

    priors: dict[str, Prior]
    """By sensor."""
    pairs: tuple[StoredPair, ...]
    made_from: str = ""
    where: str = field(default="", compare=False)
    """Its file, for errors."""

    def pair(self, source: str, target: str, choice: str = "default") -> PairCompensation:
        """Return the compensation of a source's labels for a target, by one of `CHOICES`."""
        for pair in self.pairs:
            if (pair.source, pair.target) == (source, target):
                if choice not in pair.choices:
                    raise LearningError(
                        f"{self.where}: {source} to {target} has no choice {choice!r}; known: "
                        f"{', '.join(pair.choices)}"
                    )
                chosen = pair.choices[choice]
                return PairCompensation(
                    self.priors[source], self.priors[target], chosen.d0, chosen.weight
                )
        listed = ", ".join(f"{pair.source} to {pair.target}" for pair in self.pairs)
        raise LearningError(f"{self.where}: no pair {source} to {target}; known: {listed}")

    def write(self, path: Path) -> None:
        """Write the file atomically; a different one is never replaced."""
        content = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "units": UNITS,
            "made_from": self.made_from,
            "criteria": CRITERIA,
            "priors": {name: asdict(prior) for name, prior in self.priors.items()},
            "pairs": [asdict(pair) for pair in self.pairs],
        }
        text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
        if path.exists():
            if path.read_text(encoding="utf-8") == text:
                return
            raise LearningError(f"{path}: exists and says something else; allowed: another name")
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode())


def read_stored(path: Path) -> StoredCompensation:
    """Read a compensation file."""
    content = read_json(path)
    format_name = content.get("format") if isinstance(content, dict) else None
    if format_name != FORMAT:
        raise LearningError(f"{path}.format: found {format_name!r}; allowed: {FORMAT!r}")
    version = content.get("format_version")
    if version != FORMAT_VERSION:
        raise LearningError(f"{path}.format_version: found {version!r}; allowed: {FORMAT_VERSION}")
    parts = {key: content[key] for key in ("priors", "pairs", "made_from") if key in content}
    stored = READER.build(StoredCompensation, {**parts, "where": str(path)}, str(path))
    for pair in stored.pairs:
        for name in (pair.source, pair.target):
            if name not in stored.priors:
                raise LearningError(
                    f"{path}.pairs: {name} has no prior; known: {', '.join(stored.priors)}"
                )
    return stored


# Priors of an archive's sensors, from all sources of force-depth curves.


@dataclass(frozen=True, slots=True)
class Curves:
    """Sources of force-depth curves in addition to the archive's rows."""

    sessions: Sequence[Path] = ()
    """Sessions of `tactile force-depth`; each names its sensor."""
    coefficients: Path | None = None
    """Folder of <sensor>_down.csv and <sensor>_up.csv, as published."""
    per_mm: bool = True
    """True if published coefficients are of depth in mm; else of its fraction of the range."""
    ranges_mm: Mapping[str, float] = field(default_factory=dict)
    """Depth that counts as 1, by sensor [mm], instead of the deepest located press."""


ARCHIVED = Curves()


@dataclass(frozen=True, slots=True, eq=False)
class ArchivePriors:
    """Priors, and the data of their fits."""

    priors: dict[str, Prior]
    """By sensor."""
    measured: Mapping[str, ForceDepthCurve]
    """By sensor; not for sensors with given coefficients."""
    without: tuple[str, ...]
    """Sensors without a force-depth curve."""


def gather_priors(archive: MarkerArchive, curves: Curves = ARCHIVED) -> ArchivePriors:
    """Return the priors of an archive's sensors.

    For each sensor the first available source is used: a session, published coefficients,
    force-depth rows of the archive, coefficients that were imported with it.
    """
    sessions = {curve.sensor: curve for curve in map(curve_of_session, curves.sessions)}
    published = {} if curves.coefficients is None else read_compensation(curves.coefficients)
    for name in (*sessions, *curves.ranges_mm):
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name}; known: {', '.join(archive)}")
    priors: dict[str, Prior] = {}
    measured: dict[str, ForceDepthCurve] = {}
    for name, sensor in archive.items():
        span = depth_range(sensor)
        if name in curves.ranges_mm:
            span = 1e-3 * curves.ranges_mm[name]
        curve = sessions.get(name)
        coefficients = published.get(name)
        if curve is None and coefficients is None:
            curve = curve_of_table(name, sensor.table, archive.indenters)
        if curve is not None:
            measured[name] = curve
            priors[name] = fit_prior(curve, span)
            continue
        source = "published coefficients"
        if coefficients is None:
            coefficients, source = _imported(sensor), "coefficients imported with the archive"
        if coefficients is None:
            continue
        if span is None:
            raise LearningError(
                f"{name}: has coefficients and no located press that would say how deep it was "
                "pressed; allowed: --range-mm"
            )
        priors[name] = prior_of_coefficients(
            name, coefficients, depth_range=span, per_mm=curves.per_mm, source=source
        )
    return ArchivePriors(priors, measured, tuple(name for name in archive if name not in priors))


def _imported(sensor: ArchivedSensor) -> Compensation | None:
    """Return the coefficients that were imported with a sensor; None if there are none."""
    coefficients = sensor.attrs.get("force_depth")
    if coefficients is None:
        return None
    try:
        return Compensation(
            tuple(float(value) for value in coefficients["down"]),
            tuple(float(value) for value in coefficients["up"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise LearningError(
            f"{sensor.name}.force_depth: found {coefficients!r}; allowed: down and up, numbers"
        ) from error


# Priors, and choices for pairs of sensors.

# Depth ranges whose relative difference is below this count as equal.
_ALIKE = 0.05


def write_compensation(
    archive: MarkerArchive,
    out: Path,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    curves: Curves = ARCHIVED,
    split: Path | None = None,
) -> list[str]:
    """Write the curves of `find_compensation` and their picture; return lines of tables."""
    compensation, gathered = find_compensation(archive, pairs=pairs, curves=curves, split=split)
    compensation.write(out)
    picture = out.with_suffix(".png")
    draw_curves(compensation, gathered, picture)
    return [
        *tables(compensation, gathered),
        *_labels_by_twins(archive, compensation, split),
        f"{out}, {picture}: written",
    ]


def find_compensation(
    archive: MarkerArchive,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    curves: Curves = ARCHIVED,
    split: Path | None = None,
) -> tuple[StoredCompensation, ArchivePriors]:
    """Find compensations between an archive's sensors; return them with their curves.

    `pairs` are sources and targets, by default all with a prior; `curves` are sources in addition
    to the archive's rows. Labels are those of a split's training presses, without one of all seen
    indenters.
    """
    gathered = gather_priors(archive, curves)
    wanted = _pairs_of(archive, gathered, pairs)
    compensated = []
    with ItemProgress("pairs", sys.stderr) as progress:
        for done, (source, target) in enumerate(wanted):
            progress(done, len(wanted))
            one, other = gathered.priors[source], gathered.priors[target]
            compensated.append(_chosen(one, other, paired_labels(archive, source, target, split)))
        progress(len(wanted), len(wanted))
    return StoredCompensation(gathered.priors, tuple(compensated), made_from=archive.name), gathered


def _chosen(source: Prior, target: Prior, paired: PairedLabels | None) -> StoredPair:
    default = scored_choice(paired, source, target, DEFAULT_D0, DEFAULT_WEIGHT)
    choices: dict[str, Choice] = {"default": default}
    d0s = _d0_of_paper(source, target)
    fitted = best_for_priors(source, target, d0s)
    if fitted is not None:
        choices["priors"] = scored_choice(paired, source, target, *fitted)
    if paired is not None:
        choices["oracle"] = best_for_labels(paired, source, target, d0s)
    before = scored_choice(paired, source, target, 0.0, 0.0)
    return StoredPair(
        source.sensor, target.sensor, before, choices, 0 if paired is None else len(paired)
    )


def _d0_of_paper(source: Prior, target: Prior) -> tuple[float, ...]:
    """Return starting depths as fractions of the range (the supplement's Tables S1 and S2).

    They are constant in mm for sensors of similar range, and constant as fractions for others.
    """
    spans = source.depth_range, target.depth_range
    if abs(spans[0] - spans[1]) > _ALIKE * max(spans):
        return D0_SHARES
    return tuple(mm * 1e-3 / spans[0] for mm in D0_MM if mm * 1e-3 < spans[0])


def _pairs_of(
    archive: MarkerArchive, gathered: ArchivePriors, pairs: Sequence[tuple[str, str]] | None
) -> list[tuple[str, str]]:
    how = (
        "; allowed: an archive with a force-depth session of each sensor (tactile force-depth), "
        "--session or --coefficients"
    )
    if pairs is None:
        if len(gathered.priors) < 2:
            raise LearningError(
                f"{archive.name}: found force-depth curves of "
                f"{', '.join(gathered.priors) or 'no sensor'}, expected two sensors or more{how}"
            )
        return list(permutations(gathered.priors, 2))
    for name in np.unique([name for pair in pairs for name in pair]):
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name}; known: {', '.join(archive)}")
        if name in gathered.without:
            raise LearningError(f"{archive.name}: {name} has no force-depth curve{how}")
    return list(pairs)


# Results as tables and as a plot of the curves.

# Maximum number of measured points to plot for each curve.
_POINTS = 300


def tables(compensation: StoredCompensation, gathered: ArchivePriors) -> Iterator[str]:
    """Yield the lines of a table of priors, a table of pairs and a summary."""
    halves = f"{'loading at 1/2, 1':>20}{'rms':>8}  {'unloading':>20}{'rms':>8}"
    yield f"{'sensor':<14}{'range':>9}  {halves}  [N]"
    for prior in compensation.priors.values():
        yield (
            f"{prior.sensor:<14}{1e3 * prior.depth_range:>6.2f} mm  {_fit_text(prior.loading)}"
            f"  {_fit_text(prior.unloading)}  {prior.source}"
        )
    if gathered.without:
        yield f"without a force-depth curve: {', '.join(gathered.without)}"
    yield ""
    yield f"{'labels of > for':<28}{'before':>8}" + "".join(f"{name:>24}" for name in CHOICES)
    for pair in compensation.pairs:
        name = f"{pair.source} > {pair.target}"
        cells = "".join(f"{_cell(pair.choices.get(choice)):>24}" for choice in CHOICES)
        yield f"{name:<28}{_newtons(pair.before):>8}{cells}"
    yield "mean distance of labels from the target's [N], (d0 of the depth range, lambda)"
    yield from _summary(compensation.pairs)


def draw_curves(compensation: StoredCompensation, gathered: ArchivePriors, path: Path) -> None:
    """Plot measured forces and fitted polynomials, loading and unloading, as a PNG."""
    spans = [prior.depth_range for prior in compensation.priors.values()]
    alike = max(spans) - min(spans) < 0.05 * max(spans)
    with chart(path, 9, 3.8) as figure:
        axes = figure.subplots(1, 2, sharey=True)
        for loading, panel in zip((True, False), axes, strict=True):
            for index, (name, prior) in enumerate(compensation.priors.items()):
                colour = f"C{index}"
                unit = 1e3 * prior.depth_range if alike else 1.0
                if name in gathered.measured:
                    curve = gathered.measured[name]
                    points = curve.loading if loading else curve.unloading
                    points = points[:: max(1, len(points) // _POINTS)]
                    fraction = points[:, 0] / prior.depth_range
                    panel.plot(fraction * unit, points[:, 1], ".", color=colour, ms=3, alpha=0.5)
                fraction = np.linspace(0.0, prior.share_max, 100)
                force = prior.branch(loading).compression(fraction)
                panel.plot(fraction * unit, force, color=colour, label=name)
            panel.set_title("loading" if loading else "unloading")
            panel.set_xlabel("depth [mm]" if alike else "depth over the sensor's range [1]")
        axes[0].set_ylabel("compression [N]")
        axes[0].legend()


def _labels_by_twins(
    archive: MarkerArchive, compensation: StoredCompensation, split: Path | None
) -> Iterator[str]:
    """Yield R2 of the labels of each pair whose sensors both have forces of a twin."""
    for pair in compensation.pairs:
        r2 = simulated_r2(archive, pair.source, pair.target, split)
        if r2 is not None:
            others = {"before": pair.before, **pair.choices}
            listed = "  ".join(
                f"{name} {one.r2:.2f}" for name, one in others.items() if one.r2 is not None
            )
            yield f"R2 of labels, {pair.source} > {pair.target}: {listed}  simulated {r2:.2f}"


def _fit_text(branch: Branch) -> str:
    half, whole = branch.compression(np.array([0.5, 1.0]))
    rms = "-" if branch.residual is None else f"{branch.residual:.3f}"
    return f"{half:>11.2f} {whole:>8.2f}{rms:>8}"


def _newtons(choice: Choice) -> str:
    return "-" if choice.error is None else f"{choice.error:.3f}"


def _cell(choice: Choice | None) -> str:
    if choice is None:
        return "-"
    clamped = f" {choice.clamped}!" if choice.clamped else ""
    return f"{_newtons(choice)} ({choice.d0:.2f}, {choice.weight:g}){clamped}"


def _summary(pairs: tuple[StoredPair, ...]) -> Iterator[str]:
    labelled = [(pair, pair.before.error) for pair in pairs if pair.before.error is not None]
    if not labelled:
        yield "no target has labels of its own: no error, no oracle"
        return
    for name in CHOICES:
        after = [
            (before, choice.error)
            for pair, before in labelled
            if (choice := pair.choices.get(name)) is not None and choice.error is not None
        ]
        if not after:
            continue
        better = sum(error < before for before, error in after)
        mean = np.mean(after, axis=0)
        yield (
            f"{name:<8} {mean[0]:.3f} N before, {mean[1]:.3f} N after; better in {better} of "
            f"{len(after)} pairs"
        )
    if any(choice.clamped for pair in pairs for choice in pair.choices.values()):
        yield "n!: n labels whose ratio of priors was clamped to 0.1 .. 10"
