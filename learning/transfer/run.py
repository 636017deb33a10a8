"""`tactile force --source`, stage by stage: from two recordings to a model with error bars."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from learning.compensation.fit import (
    CHOICE_OF_METHOD,
    Curves,
    gather_priors,
    read_stored,
    write_compensation,
)
from learning.compensation.search import depth_range
from learning.compensation.simulated import SIMULATED, twin_forces
from learning.config import require_same
from learning.data.labels import read_labels
from learning.data.matching import SensorSelection, Tolerances
from learning.errors import LearningError
from learning.evaluation.predictions import LABEL_FREE, after, read_predictions
from learning.experiment.running import run_experiment
from learning.experiment.settings import ExperimentSettings
from learning.experiment.stages import Experiment, Places, relabelling
from learning.force.calibrate import IntervalCalibration, presses_of_rows
from learning.force.export import export_onnx
from learning.force.intervals import Scale
from learning.force.loading import load_force_model
from learning.training.checkpoint import CONFIG, MODEL, read_model_folder, weights_hash
from learning.transfer.by_place import ByPlace, forces_at
from learning.transfer.deliver import (
    PRESSES,
    Card,
    calibration_picture,
    deliver,
    forces_picture,
    lines_of,
    write_report,
)
from learning.transfer.pairs import join_pair, split_pair
from learning.transfer.scale import error_curve, gains_of_labels
from learning.translation.archive import Pair
from recorder import MarkerArchive
from recorder.archive import archive_fingerprint
from recorder.processes import cores

Say = Callable[[str], None]

# Factors of the scale that are assumed: without any force on the target; with force-depth curves or
# twins of both skins.
NOTHING, CURVES = 2.0, 1.25
# Method with the source's labels as they are.
UNSCALED = LABEL_FREE[0]
# Relative difference of two depth ranges below which forces at the same fraction compare.
_AS_DEEP = 0.1


@dataclass(frozen=True, slots=True)
class TransferRequest:
    """A transfer from a sensor with a gauge to one without."""

    source: SensorSelection
    target: SensorSelection
    out: Path
    settings: ExperimentSettings
    source_model: Path | None = None
    """Force model of the source; None: one is trained."""
    priors: tuple[Path, ...] = ()
    """Force references of the target: sessions of `force-depth`, a folder of published
    coefficients, or the target's own archive."""
    labels: Path | None = None
    """CSV of a few labels of the target."""
    source_labels: Path | None = None
    """CSV of labels of the source, in place of those of its archive."""
    ratio: float | None = None
    """Assumed force of the target over the source's at the same fraction of depth; None: 1."""
    within: float | None = None
    """Factor within which the scale is assumed to be; None: by what is known."""
    calibrate_on: tuple[str, ...] | None = None
    """Indenters that calibrate the intervals; None: a quarter of those seen."""
    unseen: tuple[str, ...] | None = None
    """Indenters that no stage uses; None: as in the archives."""
    tolerances: Tolerances = field(default_factory=Tolerances)
    """Largest differences of presses that match."""
    device: str = "cpu"

    @property
    def model(self) -> Path:
        """Folder of the model of the target."""
        return self.out / "model"

    @property
    def before(self) -> Path:
        """Folder of the source's model."""
        return self.out / "before"


def run_transfer(request: TransferRequest, say: Say = print) -> Card:
    """Run or continue a transfer, and return the card of its model."""
    source, target = request.source.name, request.target.name
    paths = Places(request.out, request.out / "pairs.markers.zarr")
    request.out.mkdir(parents=True, exist_ok=True)
    _begin(request)

    # Presses of both sensors match by place; the target's labels stay behind.
    own_curve = any(_is_same(path, request.target.archive) for path in request.priors)
    archive, matches = join_pair(
        request.source,
        request.target,
        paths.archive,
        request.tolerances,
        request.unseen,
        source_labels=request.source_labels,
        keep_curve=own_curve,
    )
    for line in matches:
        say(line)
    split, calibrates = split_pair(
        archive, source, paths.split, request.calibrate_on, request.settings.seed
    )
    say(f"calibrate the intervals before the model learns them: {', '.join(calibrates)}")

    # Labels are scaled between the skins, if both have a force-depth curve or a twin.
    curved = _compensated(request, archive, paths, say)
    kinds = tuple(one for one in request.settings.compensation if curved or one == SIMULATED)
    method = after(kinds)
    settings = replace(request.settings, compensation=kinds)
    if request.source_model is not None:
        experiment = Experiment(paths, settings, (), request.device)
        settings = experiment.adopt(source, request.source_model)
    if method == UNSCALED:
        _require_as_deep(request, archive)
    run_experiment(
        paths,
        settings,
        pairs=[f"{source}:{target}"],
        device=request.device,
        processes=cores(),
        say=say,
    )

    # The model of translated frames learns the target's own; errors on indenters never seen become
    # intervals; the scale is what is known of it.
    translator = settings.translators[0]
    trained = paths.model(f"force-{source}-to-{target}.{method}.{translator}")
    stored = read_stored(paths.compensation) if method in CHOICE_OF_METHOD else None
    relabelled = relabelling(archive, Pair(source, target), method, stored)
    by_place = ByPlace(archive, source, target, relabelled)
    trained = by_place.tune(trained, split, settings, request.device, "by place")
    scale = _scale(request, method)
    model = load_force_model(trained, request.device)
    calibration = by_place.calibrate(model, calibrates, scale)
    # Its errors are measured: the delivered model learns the indenters that calibrated as well.
    whole = split.trained_on(calibrates)
    trained = by_place.tune(trained, whole, settings, request.device, "all")
    factor = 1.0 if method != UNSCALED or request.ratio is None else request.ratio
    intervals = calibration.intervals.rescaled(factor, scale)
    factors = np.full(3, factor)
    history: tuple[str, ...] = ()
    curve: list[dict[str, str]] = []
    if request.labels is not None:
        few = read_labels(request.labels, request.target.archive, request.target.sensor)
        predicted = factor * forces_at(archive[target], few.rows, load_force_model(trained))
        curve = error_curve(few, predicted, intervals)
        gains, scale, text = gains_of_labels(few, predicted, intervals)
        factors = factor * gains
        history = (text,)
        intervals = intervals.rescaled(gains.tolist(), scale)

    one, other = (archive[name].table["location"] for name in (source, target))
    card = Card(
        source=source,
        target=target,
        method=method,
        translator=translator,
        seen=tuple(sorted({each.indenter for each in split.presses if each.role == "train"})),
        pairs=len(np.intersect1d(one[one >= 0], other[other >= 0])),
        intervals=intervals,
        history=history,
    )
    deliver(trained, request.model, card, factors.tolist())
    _deliver_before(paths.model(f"force-{source}"), request.before)
    scaled = replace(
        calibration,
        intervals=intervals,
        predicted=factors * calibration.predicted,
        expected=factors * calibration.expected,
    )
    pictures = [*_pictures(request, archive, paths, scaled)]
    write_report(request.out / "report.html", card, matches, pictures, curve)
    for line in (*lines_of(card), *history):
        say(line)
    return card


def _begin(request: TransferRequest) -> None:
    """Write what the models of a folder are made of, or check that it is the same."""
    sensors = {"source": request.source, "target": request.target}
    twins = None
    if SIMULATED in request.settings.compensation:
        twins = [twin_forces(each.archived).made_from for each in sensors.values()]
    plain: dict[str, Any] = {
        **{
            name: f"{archive_fingerprint(each.archive)} {each.sensor} as {each.name}"
            for name, each in sensors.items()
        },
        "source_labels": request.source_labels and weights_hash(request.source_labels),
        "source_model": str(request.source_model and request.source_model.resolve()),
        "priors": sorted(str(path.resolve()) for path in request.priors),
        "calibrate_on": request.calibrate_on and sorted(request.calibrate_on),
        "unseen": request.unseen and sorted(request.unseen),
        "tolerances": asdict(request.tolerances),
        "twins": twins,
    }
    require_same(request.out / "transfer.json", plain)


def _is_same(path: Path, archive: MarkerArchive) -> bool:
    return path.exists() and path.resolve() == Path(archive.path).resolve()


def _compensated(
    request: TransferRequest, archive: MarkerArchive, places: Places, say: Say
) -> bool:
    """Fit the skins' force-depth curves; return False if one of both has none."""
    folders = [p for p in request.priors if not _is_same(p, request.target.archive)]
    sessions = [p for p in folders if not any(p.glob("*_down.csv"))]
    published = [p for p in folders if p not in sessions]
    if len(published) > 1:
        raise LearningError(f"--priors: found {len(published)} folders of CSV; allowed: one")
    curves = Curves(tuple(sessions), published[0] if published else None)
    source, target = request.source.name, request.target.name
    without = sorted({source, target} & set(gather_priors(archive, curves).without))
    if without:
        if request.priors:
            raise LearningError(
                f"--priors: no force-depth curve of {', '.join(without)} in any of them; allowed: "
                "a session of `tactile force-depth`, a folder of SENSOR_down.csv and "
                "SENSOR_up.csv, the target's own archive if it has force-depth presses"
            )
        say(f"no force-depth curve of {', '.join(without)}: labels are not scaled between skins")
        return False
    if not places.compensation.exists():
        lines = write_compensation(
            archive,
            places.compensation,
            pairs=[(source, target)],
            curves=curves,
            split=places.split,
        )
        say("\n".join(lines))
    return True


def _scale(request: TransferRequest, method: str) -> Scale:
    """Return what is known of the scale before any weight or label."""
    if method != UNSCALED:
        text = "force-depth curves of both skins; their ratio is assumed to hold for all indenters"
        if method == SIMULATED:
            text = "twins of both skins, which simulate every press; their ratio is assumed to hold"
        return Scale(request.within or CURVES, text, assumed=False)
    ratio = 1.0 if request.ratio is None else request.ratio
    text = (
        f"assumed that {request.target.name} takes {ratio:g} times the force of "
        f"{request.source.name} at the same place and fraction of depth; no force on it was ever "
        "known"
    )
    return Scale(request.within or NOTHING, text, assumed=True)


def _require_as_deep(request: TransferRequest, archive: MarkerArchive) -> None:
    """Reject an assumed scale between sensors that are not pressed as deep."""
    if request.ratio is not None:
        return
    names = request.source.name, request.target.name
    deepest = [depth_range(archive[name]) or 0.0 for name in names]
    if abs(deepest[0] - deepest[1]) > _AS_DEEP * max(deepest):
        raise LearningError(
            f"{request.source.name} was pressed {1e3 * deepest[0]:.2f} mm deep, "
            f"{request.target.name} {1e3 * deepest[1]:.2f} mm: at the same fraction of depth their "
            "forces differ by more than the skins' moduli; allowed: --priors with force-depth "
            "curves, --force-ratio, or a (simulated) source pressed as deep"
        )


def _deliver_before(trained: Path, out: Path) -> None:
    """Copy the source's model with its ONNX, for live comparison."""
    if (out / "model.onnx").exists() and (
        read_model_folder(out).hash() == read_model_folder(trained).hash()
    ):
        return
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for name in (CONFIG, f"{MODEL}.safetensors"):
        shutil.copyfile(trained / name, out / name)
    export_onnx(load_force_model(out), out / "model.onnx")


def _pictures(
    request: TransferRequest,
    archive: MarkerArchive,
    places: Places,
    calibration: IntervalCalibration,
) -> Iterator[tuple[str, bytes]]:
    yield (
        "Predicted and expected forces on the indenters that calibrate",
        calibration_picture(calibration),
    )
    pair = f"{request.source.name}-to-{request.target.name}"
    source_only = read_predictions(places.predictions / f"{pair}.source-only.npz")
    unseen = np.flatnonzero(~np.isin(source_only.indenter, calibration.intervals.indenters))
    rows = unseen if len(unseen) else np.arange(len(source_only))
    locations = np.unique(source_only.location[rows])
    chosen = locations[np.linspace(0, len(locations) - 1, PRESSES).round().astype(int)]
    rows = rows[np.isin(source_only.location[rows], chosen)]
    rows = rows[np.lexsort((source_only.frame[rows], source_only.location[rows]))]
    model = load_force_model(request.model)
    presses = presses_of_rows(archive[request.target.name], source_only.rows[rows], model)
    starts = np.flatnonzero(np.diff(source_only.location[rows], prepend=-1))
    names = ", ".join(dict.fromkeys(source_only.indenter[rows].tolist()))
    yield (
        f"Forces of some presses of {request.target.name}, of {names}",
        forces_picture(
            model.predict(presses),
            source_only.predicted[rows],
            calibration.intervals,
            starts.tolist(),
        ),
    )
