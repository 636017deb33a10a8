"""The jobs of the chain: each trains or scores one thing, and appends rows to CSV files.

A job runs in its own process on one device. Trainings have a time, not a number of steps: some are
timed first, and as many are done as fit. A job that is repeated goes on: networks are read from
their checkpoints, and rows that exist are not computed again.
"""

from __future__ import annotations

import csv
import fcntl
import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.learning.paper_chain.card import card
from benchmarks.learning.paper_chain.sizes import ALONE, RECIPES, SEED, Size, write_base
from benchmarks.learning.sums import r_squared_of_sums
from learning.compensation.fit import PairCompensation, StoredCompensation, find_compensation
from learning.config import read_settings
from learning.data.images import shrink, shrink_masks, unpack_masks
from learning.data.pairs import paired_rows, read_paired
from learning.data.presses import Presses, load_presses, read_frames, read_frames_of
from learning.data.splits import Role, Split, make_split
from learning.errors import LearningError
from learning.evaluation.distribution import (
    Extractor,
    frechet_distance,
    kernel_distance,
    load_extractor,
)
from learning.evaluation.translation import (
    NEAREST,
    REFERENCE,
    SOURCE,
    RealFrames,
    nearest_frames,
    overlap,
    paired_score,
)
from learning.experiment.frames import frames_of_a_press, look_of, translate_presses
from learning.force.export import export_onnx
from learning.force.labels import compensated
from learning.force.model import KIND as FORCE
from learning.force.model import ForceModel, load_force_model
from learning.force.train import PRESETS as NET_PRESETS
from learning.force.train import ForceModelSettings, ForceStageSettings, train_force
from learning.metrics import r_squared
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder, Stop, TrainingSession, accelerator, generator
from learning.translation.diffusion import train as m2m
from learning.translation.diffusion.network import KIND as M2M
from learning.translation.diffusion.network import MARKER_VAE as VAE
from learning.translation.diffusion.network import load_vae_adapter
from learning.translation.diffusion.train_vae import MarkerVaeSettings, train_vae
from learning.translation.diffusion.weights import BASE, fingerprint, read_unet, read_vae
from learning.translation.field import train as field
from learning.translation.field.data import gather_role
from learning.translation.loading import load_translator
from learning.translation.translator import SensorView, Translator, for_pair
from recorder import MarkerArchive
from recorder.archive import location_pairs
from recorder.markers import pack, unpack

Floats = NDArray[np.float64]
TRANSLATORS = ("m2m", "field")
UNSEEN: Role = "new_indenter"
# Steps, and epochs, that are timed before a training, until they take some time [s].
PROBE, PROBED_EPOCHS, ENOUGH_S = 12, 1, 1.5
# Resamples of the test indenters, and the interval between their quantiles.
RESAMPLES, INTERVAL = 2000, (0.05, 0.95)
# Side of the images that the nearest frame is searched in.
SMALL = 64


def archive_file(name: str) -> str:
    """Return the file name of an archive."""
    return f"{name}.markers.zarr"


class Joined(MarkerArchive):
    """Archives of single sensors as one, with locations in common."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Open the archives.

        Raises:
            LearningError: They have other indenters.
            SessionError: One is not an archive.
        """
        super().__init__(paths[0])
        for path in paths[1:]:
            other = MarkerArchive(path)
            if other.indenters != self.indenters:
                raise LearningError(f"{path}: indenters differ from those of {paths[0]}")
            self._sensors |= dict(other.items())


@dataclass(frozen=True, eq=False)
class Chain:
    """Surroundings of a job."""

    out: Path
    size: Size
    minutes: float
    device: torch.device
    processes: int
    seed: int = SEED
    """Seed of trainings."""

    @property
    def base(self) -> str:
        """Folder of the untrained networks."""
        return str(self.out / "base")

    @cached_property
    def archive(self) -> MarkerArchive:
        """Frames of the sensors, with labels."""
        return Joined([self.out / archive_file(name) for name in self.size.archives])

    @cached_property
    def patterns(self) -> MarkerArchive:
        """States of one gel under many patterns."""
        return MarkerArchive(self.out / archive_file("patterns"))

    @cached_property
    def split(self) -> Split:
        """Presses of the sensors: seen indenters for training, the others for the test."""
        out = self.size.held_out
        return make_split(self.archive, validation=0, new_press=0, held_out_sensors=out)

    @cached_property
    def compensation(self) -> StoredCompensation | None:
        """Compensation of labels between skins; None: all skins are alike."""
        return find_compensation(self.archive)[0] if self.size.compensated else None

    def relabelling(self, source: str, target: str) -> PairCompensation | None:
        """Return what compensates a source's labels for a target, or None."""
        if self.compensation is None:
            return None
        return self.compensation.pair(source, target, "priors")

    def seconds(self, kind: str) -> float:
        """Training time of a kind of job [s]."""
        return 60 * self.minutes * self.size.parts[kind]

    def model(self, name: str) -> Path:
        """Folder of a trained network."""
        return self.out / "models" / name

    def presses(self, sensor: str, role: Role, form: Any = "images") -> Presses:
        """Presses of a sensor that have a role."""
        found = self.archive[sensor]
        rows = self.split.rows(found.table, role)
        options = {"form": form, "device": self.device, "processes": self.processes}
        return load_presses(found, rows, **options)

    def add(self, table: str, row: dict[str, Any]) -> None:
        """Append a row to a CSV file; jobs in other processes append to the same."""
        with (self.out / f"{table}.csv").open("a", newline="") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            writer = csv.DictWriter(file, list(row))
            if not file.tell():
                writer.writeheader()
            writer.writerow(row)
        print(json.dumps(row), flush=True)

    def rows(self, table: str) -> list[dict[str, str]]:
        """Rows of a CSV file; none if there is no file."""
        path = self.out / f"{table}.csv"
        if not path.exists():
            return []
        with path.open(newline="") as file:
            return list(csv.DictReader(file))

    def has(self, table: str, **key: str) -> bool:
        """Return True if a row exists."""
        return any(key.items() <= row.items() for row in self.rows(table))


def fitting(
    chain: Chain, name: str, part: str, launch: Any, train: Callable[[int, TrainingSession], object]
) -> int:
    """Return the number of steps, or epochs, that fit in a job's time; read it if it is stored.

    Args:
        chain: Surroundings.
        name: Name of the network.
        part: Kind of the job, which has the time.
        launch: Device and precision.
        train: Trains a given number of steps, in memory.
    """
    stored = chain.model(name).with_suffix(".json")
    if stored.exists():
        return int(json.loads(stored.read_text())["steps"])
    stamps: dict[int, float] = {}

    def stamp(done: int, of: int) -> None:
        if chain.device.type == "cuda":
            torch.cuda.synchronize()
        stamps[done] = time.perf_counter()

    units = PROBED_EPOCHS if part == "net" else PROBE
    while True:
        stamps.clear()
        train(units, TrainingSession(accelerator(launch), progress=stamp))
        total = len(stamps)
        if total >= 4:
            # Medians of both halves: a start, or work between two stages, is no step.
            halves = np.array_split(np.diff(list(stamps.values())), 2)
            per_unit = float(np.mean([np.median(each) for each in halves])) * total / units
            if per_unit * units > ENOUGH_S:
                break
        units *= 4
    return _stored(chain, name, part, per_unit)


def _stored(chain: Chain, name: str, part: str, per_unit: float) -> int:
    """Return the steps that fit, and store them with their time."""
    steps = max(2, int(chain.seconds(part) / per_unit))
    stored = chain.model(name).with_suffix(".json")
    stored.parent.mkdir(parents=True, exist_ok=True)
    stored.write_text(json.dumps({"steps": steps, "seconds_a_step": per_unit}))
    return steps


@contextmanager
def run_of(
    chain: Chain, name: str, kind: str, settings: Any, data: str, metadata: Any = None
) -> Iterator[tuple[RunFolder, TrainingSession]]:
    """Yield the folder of a training and its session; on a stop the job ends, to be repeated."""
    began = time.perf_counter()
    launched = accelerator(settings.launch)
    run = RunFolder.open(chain.model(name), kind, settings, data, metadata=metadata)
    with Stop(lambda line: print(line, file=sys.stderr)) as stop:
        yield run, TrainingSession(launched, run, stop)
        if not run.finished:
            raise KeyboardInterrupt
    seconds = round(time.perf_counter() - began, 1)
    chain.add("trainings", {"network": name, "kind": kind, "seconds": seconds, "seed": chain.seed})


# Autoencoder, translators


def _common(chain: Chain, steps: int) -> list[str]:
    size = chain.size
    return [
        "whole=true",
        f"steps={steps}",
        f"batch={size.batch}",
        f"seed={SEED}",
        f"launch.mixed_precision={size.precision}",
        f"checkpoint_every={max(1, steps // 4)}",
        f"validate_every={steps}",
        f"weights.base={json.dumps(chain.base)}",
    ]


def _rate(rate: float, steps: int) -> str:
    warm = min(200, steps // 10)
    return f"optimiser={{rate: {{kind: cosine, rate: {rate}, steps: {steps}, warm_up: {warm}}}}}"


def vae(chain: Chain) -> None:
    """Train the marker autoencoder on the frames of all sensors and patterns."""
    write_base(Path(chain.base), chain.size)
    if (chain.model("vae") / "model.safetensors").exists():
        return
    data = [(chain.archive, chain.split)]
    if chain.size.patterns is not None:
        data.append((chain.patterns, _patterns_split(chain)))
    images = torch.cat(
        [
            read_frames_of(
                [archive[name] for name in split.trained_sensors(archive)],
                [
                    split.rows(archive[name].table, "train")
                    for name in split.trained_sensors(archive)
                ],
                chain.device,
            )
            for archive, split in data
        ]
    )

    def settings(steps: int) -> MarkerVaeSettings:
        stage = [f"steps={steps}", f"batch={chain.size.batch}", _rate(1e-3, steps)]
        stage += [f"mixed_precision={chain.size.precision}"]
        given = [*_common(chain, steps), *(f"marker_vae.{each}" for each in stage)]
        return read_settings(m2m.TranslatorSettings, m2m.PRESETS, "ours", given).of_marker_vae()

    def train(steps: int, session: TrainingSession) -> None:
        train_vae(images, read_vae(chain.base), settings(steps), None, session)

    steps = fitting(chain, "vae", "vae", settings(PROBE).launch, train)
    base = {BASE: fingerprint(chain.base)}
    with run_of(chain, "vae", VAE, settings(steps), "frames", base) as (_, session):
        train(steps, session)


def m2m_patterns(chain: Chain) -> None:
    """Train the translator on all pairs of patterns, from the autoencoder."""
    begun = load_vae_adapter(chain.model("vae"), fingerprint(chain.base))
    split = _patterns_split(chain)
    _translator(chain, "m2m-patterns", chain.patterns, split, 3e-4, vae_adapter=begun)


def m2m_sensors(chain: Chain) -> None:
    """Train that translator further on the location pairs of the sensors, or a new one on these."""
    if chain.size.patterns is None:
        new = load_vae_adapter(chain.model("vae"), fingerprint(chain.base))
        _translator(chain, "m2m", chain.archive, chain.split, 3e-4, vae_adapter=new)
        return
    begun = read_model_folder(chain.model("m2m-patterns"), M2M).weights()
    _translator(chain, "m2m", chain.archive, chain.split, 2e-4, start_from=begun)


def _translator(
    chain: Chain, name: str, archive: MarkerArchive, split: Split, rate: float, **begun: Any
) -> None:
    if (chain.model(name) / "model.safetensors").exists():
        return
    rows = paired_rows(archive, split, split.trained_sensors(archive), "train")
    pairs = read_paired(archive, rows, device=chain.device)
    print(f"{len(pairs.pairs):,} location pairs", flush=True)

    def settings(steps: int) -> m2m.TranslatorSettings:
        # The paper's inputs; its losses with published weights are left out.
        given = [*_common(chain, steps), _rate(rate, steps), "sample_latents=false"]
        given += ["conditioning=channel_tokens", "source_reference=false"]
        given += ["losses={adversarial: 0, perceptual: 0, square: 1}"]
        return read_settings(m2m.TranslatorSettings, m2m.PRESETS, "paper_main", given)

    def train(steps: int, session: TrainingSession) -> None:
        networks = m2m.Pretrained(read_unet(chain.base), read_vae(chain.base))
        m2m.train(pairs, networks, settings(steps), None, session, **begun)

    steps = fitting(chain, name, name, settings(PROBE).launch, train)
    base = {BASE: fingerprint(chain.base)}
    with run_of(chain, name, M2M, settings(steps), archive.name, base) as (_, session):
        train(steps, session)


def field_translator(chain: Chain) -> None:
    """Train the field translator on the same frames, without a simulator's true displacement."""
    if (chain.model("field") / "model.safetensors").exists():
        return
    sensors = chain.split.trained_sensors(chain.archive)
    frames = gather_role(chain.archive, chain.split, sensors, "train", device=chain.device)
    if frames is None:
        raise LearningError(f"{chain.archive.name}: found no press to train on; allowed: some")
    without = replace(frames, shift=None)
    preset, *given = chain.size.field_preset

    def settings(steps: int) -> field.FieldSettings:
        half = [f"{stage}.steps={steps // 2}" for stage in ("field_stage", "map_stage")]
        half += [f"seed={chain.seed}", f"validate_every_steps={steps}"]
        return read_settings(field.FieldSettings, field.PRESETS, preset, [*given, *half])

    def train(steps: int, session: TrainingSession) -> None:
        field.train_field(without, settings(steps), None, session)

    steps = fitting(chain, "field", "field", settings(PROBE).launch, train)
    with run_of(chain, "field", "field", settings(steps), "frames") as (_, session):
        train(steps, session)


# Force nets


def net(
    chain: Chain,
    preset: str,
    name: str,
    presses: Presses,
    start_from: ForceModel | None = None,
    compensation: PairCompensation | None = None,
    changed: Sequence[str] = (),
) -> ForceModel:
    """Return a force net, trained for its time if it is not there; from another's weights if given.

    A preset's stages get equal parts of the time; a net that goes on has only its last. `changed`
    are further overrides of its settings.
    """
    part = "net" if start_from is None else "tuned"
    presses = presses if compensation is None else compensated(compensation).of(presses)
    folder = chain.model(name)

    def settings(epochs: int) -> ForceModelSettings:
        given = [f"seed={SEED}", "patience_epochs=null"]
        if chain.device.type == "cuda":
            given += RECIPES.get(preset, ())
        given += changed
        found = read_settings(ForceModelSettings, NET_PRESETS, preset, given)
        stages = found.stages if start_from is None else found.stages[-1:]
        count = max(1, epochs // len(stages))
        own = tuple(shortened(stage, count, len(presses), found) for stage in stages)
        return replace(found, stages=own)

    def train(epochs: int, session: TrainingSession) -> None:
        own = settings(epochs)
        train_force(presses, own, session, start_from=start_from)

    if not (folder / "model.safetensors").exists():
        epochs = fitting(chain, name, part, settings(PROBE).launch, train)
        with run_of(chain, name, FORCE, settings(epochs), presses.sensor) as (_, session):
            train(epochs, session)
    return load_force_model(folder, chain.device)


def shortened(
    stage: ForceStageSettings, epochs: int, presses: int, settings: ForceModelSettings
) -> ForceStageSettings:
    """Return a stage of another number of epochs."""
    steps = epochs * -(-presses // settings.sequences.batch)
    return replace(stage, epochs=epochs, warm_up_steps=min(stage.warm_up_steps, steps // 10))


def forces(chain: Chain, method: str, preset: str, ends: tuple[str, str], found: Floats) -> None:
    """Add the errors of forces on a target's unseen indenters, with intervals over indenters."""
    source, target = ends
    table = chain.archive[target].table
    rows = unseen_presses(chain, target).rows.numpy()
    errors = force_scores(
        table["wrench"][rows, :3].astype(np.float64), found, table["indenter"][rows]
    )
    key = {"method": method, "net": preset, "source": source, "target": target}
    chain.add("forces", {**key, **errors, "frames": len(rows), "seed": SEED})


def force_scores(true: Floats, found: Floats, indenter: NDArray[Any]) -> dict[str, float]:
    """Return R2 (mean of axes), and MAE [N], with their 90 % intervals over indenters.

    Args:
        true: Labels (n, 3) N.
        found: Predictions (n, 3) N.
        indenter: Code of the indenter of each frame (n,).
    """
    names, of = np.unique(indenter, return_inverse=True)
    # Sums by indenter, from which those of a resample are sums.
    parts = [np.ones_like(true), true, true**2, (found - true) ** 2, np.abs(found - true)]
    sums = np.stack([np.stack([part[of == k].sum(0) for k in range(len(names))]) for part in parts])
    chosen = generator(SEED, "indenters").integers(len(names), size=(RESAMPLES, len(names)))
    drawn = sums[:, chosen].sum(axis=2)  # (5, resamples, 3)
    count, one, square, missed, off = drawn
    r2 = r_squared_of_sums(count, one, square, missed).mean(axis=1)
    mae = off / count
    r2_low, r2_high = np.nanquantile(r2, INTERVAL)
    shear, normal = mae[:, :2].mean(axis=1), mae[:, 2]
    axes, mean_off = r_squared(true, found), np.abs(found - true).mean(axis=0)
    result = {"r2": axes.mean(), "r2_low": r2_low, "r2_high": r2_high}
    result |= {f"r2_{axis}": value for axis, value in zip(("fx", "fy", "fz"), axes, strict=True)}
    result |= {"mae_shear_n": mean_off[:2].mean(), "mae_fz_n": mean_off[2]}
    for name, values in (("mae_shear", shear), ("mae_fz", normal)):
        low, high = np.quantile(values, INTERVAL)
        result |= {f"{name}_low_n": low, f"{name}_high_n": high}
    return {name: round(float(value), 4) for name, value in result.items()}


def form_of(preset: str) -> Any:
    """Return the form of presses that a net reads."""
    return "field" if preset == "displacement" else "images"


@cache
def unseen_presses(chain: Chain, sensor: str, form: Any = "images") -> Presses:
    """Return the presses of a sensor under unseen indenters."""
    return chain.presses(sensor, UNSEEN, form)


def own(chain: Chain, sensor: str) -> None:
    """Train the nets of a sensor that others need, and predict without a translator."""
    targets = [name for name in chain.archive if name != sensor]
    for preset in dict.fromkeys((chain.size.net, "displacement")):
        form = form_of(preset)
        presses = chain.presses(sensor, "train", form)
        model = net(chain, preset, f"{preset}-{sensor}", presses)
        if not chain.has("forces", method="own labels", net=preset, target=sensor):
            found = model.predict(unseen_presses(chain, sensor, form))
            forces(chain, "own labels", preset, (sensor, sensor), found)
        method = "displacement" if preset == "displacement" else "source-only"
        for target in targets:
            if chain.has("forces", method=method, source=sensor, target=target):
                continue
            used, changed = model, chain.relabelling(sensor, target)
            if method == "displacement" and changed is not None:
                used = net(
                    chain, preset, f"{preset}-{sensor}-for-{target}", presses, model, changed
                )
            found = used.predict(unseen_presses(chain, target, form))
            forces(chain, method, preset, (sensor, target), found)
    for target in targets:
        if not chain.has("forces", method=NEAREST, source=sensor, target=target):
            forces(chain, NEAREST, "-", (sensor, target), nearest_labels(chain, sensor, target))


def nearest_labels(chain: Chain, source: str, target: str) -> Floats:
    """Return for each test frame the source's label of the most similar location pair.

    The pairs are those that the translators are trained on: the target's images, the source's
    labels. Similar is by mean square of the images' change from no contact.
    """
    one, other = chain.archive[source], chain.archive[target]
    pairs = location_pairs(one.table, other.table)
    kept = np.isin(pairs.target, chain.split.rows(other.table, "train"))
    rows = pairs.source[kept]
    labels = one.table["wrench"][rows, :3].astype(np.float64)
    changed = chain.relabelling(source, target)
    if changed is not None:
        depth, phase = one.table["depth"][rows], one.table["phase"][rows]
        labels, _ = changed.applied(labels, depth.astype(np.float64), phase.astype(np.int64))
    unseen = unseen_presses(chain, target).rows.numpy()

    def changes(rows: NDArray[np.int64]) -> torch.Tensor:
        images = read_frames(other, rows, chain.device).float()
        still = torch.from_numpy(shrink(other.references)).to(chain.device).float()
        of = torch.from_numpy(other.table["reference"][rows].astype(np.int64)).to(chain.device)
        change = (images - still[of])[:, None]
        return torch.nn.functional.interpolate(change, (SMALL, SMALL), mode="area").flatten(1)

    apart = torch.cdist(changes(unseen), changes(pairs.target[kept]))
    return np.asarray(labels[apart.argmin(dim=1).cpu().numpy()], np.float64)


def nets(chain: Chain, sensor: str) -> None:
    """Train the other force nets of a sensor on its own labels, for the same time."""
    for preset in chain.size.nets:
        if preset in (chain.size.net, "displacement"):
            continue
        model = net(chain, preset, f"{preset}-{sensor}", chain.presses(sensor, "train"))
        if not chain.has("forces", method="own labels", net=preset, target=sensor):
            found = model.predict(unseen_presses(chain, sensor))
            forces(chain, "own labels", preset, (sensor, sensor), found)


def memory(chain: Chain, sensor: str) -> None:
    """Train nets on a sensor's own labels, with the frames of a press in order and each alone."""
    of_a_press = frames_of_a_press(chain.archive)
    for preset in chain.size.nets:
        form = form_of(preset)
        batch = read_settings(ForceModelSettings, NET_PRESETS, preset, []).sequences.batch
        alone = ("input.alone=true", f"sequences.batch={batch * of_a_press}")
        for method, name, changed in (
            ("own labels", f"{preset}-{sensor}", ()),
            (ALONE, f"{preset}-{sensor}-alone", alone),
        ):
            if chain.has("forces", method=method, net=preset, target=sensor):
                continue
            model = net(chain, preset, name, chain.presses(sensor, "train", form), changed=changed)
            found = model.predict(unseen_presses(chain, sensor, form))
            forces(chain, method, preset, (sensor, sensor), found)


# Translated frames: images, and forces by nets trained on them


def pairs(chain: Chain, translator: str, source: str) -> None:
    """Score a translator's images of unseen indenters, and nets that are trained on its frames."""
    size, archive = chain.size, chain.archive
    model = load_translator(chain.model(translator), chain.device)
    one = archive[source]
    begun = chain.model(f"{size.net}-{source}")
    # It may be trained by another command, on another GPU.
    while not (begun / "model.safetensors").exists():
        print(f"waiting for {begun.name}", flush=True)
        time.sleep(5)
    start = load_force_model(begun, chain.device)
    packed = chain.presses(source, "train", "packed")
    for target in archive:
        if target == source:
            continue
        ends, other = (source, target), archive[target]
        of_pair = for_pair(model, SensorView.of(one), SensorView.of(other))
        if not chain.has("images", method=translator, source=source, target=target):
            _images(chain, translator, ends, of_pair)
        if chain.has("forces", method=translator, source=source, target=target):
            continue
        began = time.perf_counter()
        shown = translate_presses(packed, look_of(other, packed, chain.device), of_pair)
        seconds = time.perf_counter() - began
        rate = {"translator": translator, "source": source, "target": target}
        chain.add("rates", {**rate, "frames": packed.frames, "seconds": round(seconds, 2)})
        name = f"{size.net}-{source}-to-{target}-{translator}"
        tuned = net(chain, size.net, name, shown, start, chain.relabelling(source, target))
        forces(chain, translator, size.net, ends, tuned.predict(unseen_presses(chain, target)))


def _images(chain: Chain, name: str, ends: tuple[str, str], translator: Translator) -> None:
    """Add scores of translated frames and, once, of the baselines; keep the worst frames."""
    source, target = (chain.archive[end] for end in ends)
    found = location_pairs(source.table, target.table)
    kept = np.flatnonzero(np.isin(found.source, chain.split.rows(source.table, UNSEEN)))
    some = generator(SEED, "scored").permutation(len(kept))[: chain.size.scored]
    before, after = found.source[kept[some]], found.target[kept[some]]
    translated = _translated(chain, source, target, (before, after), translator)
    train = chain.split.rows(target.table, "train")
    shown = {name: translated}
    if name == TRANSLATORS[-1]:
        shown |= {
            SOURCE: source.packed(before),
            REFERENCE: target.references[target.table["reference"][after]],
            NEAREST: target.packed(nearest_frames(target.table, after, train)),
        }
    real = RealFrames(target, after)
    true = _features(chain, real.packed)
    dice = overlap(unpack(translated), unpack(real.packed)).dice
    worst = dice.argsort()[:2]
    frames = [source.packed(before[worst]), translated[worst], real.packed[worst]]
    (chain.out / "worst").mkdir(exist_ok=True)
    np.savez_compressed(
        chain.out / "worst" / f"{name}-{ends[0]}-{ends[1]}.npz",
        frames=np.stack([shrink(each) for each in frames]),
        dice=dice[worst],
    )
    for method, packed in shown.items():
        score = paired_score(packed, real, UNSEEN, method)
        row = {"method": method, "source": ends[0], "target": ends[1], "frames": len(packed)}
        for key in ("dice", "centroid_px", "centroid_p95_px", "count_mismatch", "ssim"):
            row[key] = round(getattr(score, key), 4)
        chain.add("images", {**row, **_distances(chain, true, _features(chain, packed))})


def _translated(
    chain: Chain,
    source: Any,
    target: Any,
    rows: tuple[NDArray[np.int64], NDArray[np.int64]],
    translator: Translator,
) -> NDArray[np.uint8]:
    """Return packed frames (n, 38400) of the source, as the target would have shown them.

    Args:
        chain: Surroundings.
        source: Sensor to translate from.
        target: Sensor to translate to.
        rows: Their rows of the same moments (n,), (n,).
        translator: Translator for this pair.
    """
    made = np.empty((len(rows[0]), 38400), np.uint8)
    ends = tuple(zip((source, target), rows, strict=True))
    stills = np.stack([end.table["reference"][own] for end, own in ends], axis=1)
    for numbers in np.unique(stills, axis=0).tolist():
        here = np.flatnonzero((stills == numbers).all(axis=1))
        packed = [end.references[[number]] for (end, _), number in zip(ends, numbers, strict=True)]
        before, after = (_masks(each).to(chain.device)[0] for each in packed)
        masks = _masks(source.packed(rows[0][here])).to(chain.device)
        made[here] = pack(translator.translate(masks, after, before).cpu().numpy())
    return made


def _masks(packed: NDArray[np.uint8]) -> torch.Tensor:
    return unpack_masks(torch.from_numpy(packed))


# Distances between sets of images, by features of the autoencoder of this chain


def _features(chain: Chain, packed: NDArray[np.uint8]) -> Floats:
    """Return 256 features (n, 256) of the chain's marker VAE."""
    parts = torch.from_numpy(packed).split(64)
    images = [shrink_masks(unpack_masks(part.to(chain.device))).cpu().numpy() for part in parts]
    return _extractor(chain).features(np.concatenate(images))


@cache
def _extractor(chain: Chain) -> Extractor:
    return load_extractor(str(chain.model("vae")), str(chain.device))


def _distances(chain: Chain, true: Floats, found: Floats) -> dict[str, Any]:
    kernel, spread = kernel_distance(true, found, size=100, subsets=20, seed=SEED)
    return {
        "frechet": round(frechet_distance(true, found), 4),
        "kernel": round(kernel, 5),
        "kernel_std": round(spread, 5),
        "features": _extractor(chain).name,
    }


def _patterns_split(chain: Chain) -> Split:
    out = chain.size.held_out_patterns
    return make_split(chain.patterns, validation=0, new_press=0, held_out_sensors=out)


def patterns(chain: Chain) -> None:
    """Score all pairs of patterns before and after translation, under unseen indenters."""
    model = load_translator(chain.model("m2m-patterns"), chain.device)
    archive, split = chain.patterns, _patterns_split(chain)
    first = archive[next(iter(archive))]
    rows = split.rows(first.table, UNSEEN)
    rows = rows[generator(SEED, "states").permutation(len(rows))[: chain.size.scored]]
    location = first.table["location"][rows]

    def rows_of(sensor: Any) -> NDArray[np.int64]:
        order = np.argsort(sensor.table["location"], kind="stable")
        return np.asarray(order[np.searchsorted(sensor.table["location"][order], location)])

    real = {name: archive[name].packed(rows_of(archive[name])) for name in archive}
    known = {name: _features(chain, packed) for name, packed in real.items()}
    for source, target in permutations(archive, 2):
        if chain.has("patterns", source=source, target=target):
            continue
        one, other = archive[source], archive[target]
        made = _translated(chain, one, other, (rows_of(one), rows_of(other)), model)
        row: dict[str, Any] = {"source": source, "target": target, "states": len(rows)}
        for when, packed, features in (
            ("before", real[source], known[source]),
            ("after", made, _features(chain, made)),
        ):
            dice = overlap(unpack(packed), unpack(real[target])).dice.mean()
            far = _distances(chain, known[target], features)
            row |= {f"dice_{when}": round(float(dice), 4)}
            row |= {f"{key}_{when}": far[key] for key in ("frechet", "kernel")}
        chain.add("patterns", {**row, "features": far["features"]})
    embedded_file = chain.out / "patterns.npz"
    if not embedded_file.exists():
        few = {name: features[:60] for name, features in known.items()}
        source, *others = archive
        for target in others:
            ends = archive[source], archive[target]
            made = _translated(chain, *ends, (rows_of(ends[0]), rows_of(ends[1])), model)
            few[f"{source} to {target}"] = _features(chain, made)[:60]
        np.savez_compressed(embedded_file, allow_pickle=False, **few)


def latency(chain: Chain) -> None:
    """Time the force nets frame by frame, on this device and on two threads of the CPU."""
    from tempfile import TemporaryDirectory

    from benchmarks.recording.latency import Variant, costs, sample_of_noise

    sensor = next(iter(chain.archive))
    for preset in chain.size.nets:
        if chain.has("latency", net=preset):
            continue
        model = load_force_model(chain.model(f"{preset}-{sensor}"), chain.device)
        variants = (Variant("torch", "fp32"), Variant("onnxruntime", "fp32"))
        with TemporaryDirectory() as folder:
            found = costs(
                preset,
                model,
                sample_of_noise(model, 10),
                Path(folder),
                threads=2,
                variants=variants,
            )
        device = torch.cuda.get_device_name() if chain.device.type == "cuda" else "CPU"
        for cost in found:
            where = device if cost.runtime == "torch" else "CPU"
            row = {"net": preset, "weights": cost.weights, "runtime": cost.runtime, "on": where}
            row |= {"p50_ms": cost.p50_ms, "p99_ms": cost.p99_ms, "remark": cost.remark}
            chain.add("latency", row)


def weights(chain: Chain) -> None:
    """Copy the nets of the sensors' own labels, with ONNX and cards, to `weights` of the folder."""
    for row in chain.rows("forces"):
        preset, sensor = row["net"], row["target"]
        out = chain.out / "weights" / f"{sensor}-{preset}"
        if row["method"] != "own labels" or out.exists():
            continue
        folder = chain.model(f"{preset}-{sensor}")
        part = out.with_name(f".{out.name}")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for name in ("config.yaml", "model.safetensors"):
            shutil.copyfile(folder / name, part / name)
        export_onnx(load_force_model(folder), part / "model.onnx")
        (part / "card.md").write_text(_card(chain, row), encoding="utf-8")
        part.rename(out)


def _card(chain: Chain, row: dict[str, str]) -> str:
    """Return the card of the net of a sensor's own labels, by its row of errors."""
    preset, sensor = row["net"], row["target"]
    table = chain.archive[sensor].table
    trained, tested = (chain.split.rows(table, role) for role in ("train", UNSEEN))

    def indenters(rows: NDArray[np.int64]) -> list[str]:
        return [chain.archive.indenters[code] for code in np.unique(table["indenter"][rows])]

    count = {each["net"]: int(each["weights"]) for each in chain.rows("latency")}
    took = {each["network"]: float(each["seconds"]) for each in chain.rows("trainings")}
    return card(
        row,
        millions=count[preset] / 1e6,
        archive=f"{sensor} --tier {chain.size.tier} {' '.join(chain.size.archive)}",
        frames=len(trained),
        trained=indenters(trained),
        tested=indenters(tested),
        seconds=took[f"{preset}-{sensor}"],
    )


def names(size: Size) -> dict[str, tuple[str, ...]]:
    """Return the names of all jobs, the most urgent first, and those that each needs."""
    data = tuple(f"archive {name}" for name in size.archives)
    if size.memory:
        return {f"memory {name}": data for name in size.trained}
    jobs: dict[str, tuple[str, ...]] = {"vae": data, "m2m": ("vae",)}
    if size.patterns is not None:
        jobs = {"vae": ("archive patterns", *data), "m2m-patterns": ("vae",)}
        jobs |= {"m2m": ("m2m-patterns",)}
    jobs |= {f"own {name}": data for name in size.trained}
    jobs |= {"field": data}
    if {*size.nets} - {size.net, "displacement"}:
        jobs |= {f"nets {name}": data for name in size.trained}
    for translator in TRANSLATORS:
        for name in size.trained:
            jobs[f"pairs {translator} {name}"] = ("vae", translator, f"own {name}")
    if size.patterns is not None:
        jobs["patterns"] = ("m2m-patterns",)
    trained = (name for name in jobs if name.startswith(("own", "nets")))
    jobs["latency"] = tuple(trained)
    jobs["weights"] = ("latency",)
    return jobs


def run_job(chain: Chain, name: str) -> None:
    """Run a job by its name."""
    kind, *arguments = name.split()
    found: dict[str, Callable[..., None]] = {
        "vae": vae,
        "m2m-patterns": m2m_patterns,
        "m2m": m2m_sensors,
        "field": field_translator,
        "own": own,
        "patterns": patterns,
        "pairs": pairs,
        "nets": nets,
        "memory": memory,
        "latency": latency,
        "weights": weights,
    }
    found[kind](chain, *arguments)
