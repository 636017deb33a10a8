"""The paper's chain from nothing: marker VAE, one-step translator, force nets on its frames.

Trainings have a time, not a number of steps: some steps are timed first, and as many are done as
fit. Beside the chain: the field translator without a simulator's true displacement, the nearest
frame, a net of marker displacement without a translator, the source's net as it is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.paper.scores import force_scores, image_rows, pattern_rows
from benchmarks.paper.sizes import RECIPES, Size
from benchmarks.paper.study import (
    Joined,
    Study,
    form_of,
    nearest_labels,
    once,
    shortened,
    simulate,
)
from benchmarks.report import Run
from learning.compensation.fit import PairCompensation
from learning.config import read_settings
from learning.data.pairs import paired_rows, read_paired
from learning.data.presses import Presses, read_frames_of
from learning.data.splits import Split, make_split
from learning.errors import LearningError
from learning.evaluation.translation import NEAREST
from learning.experiment.frames import frames_of_a_press, look_of, translate_presses
from learning.force.labels import compensated
from learning.force.model import KIND as FORCE
from learning.force.model import ForceModel, load_force_model
from learning.force.train import PRESETS as NET_PRESETS
from learning.force.train import ForceModelSettings, train_force
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder, TrainingSession, accelerator, session_of
from learning.translation.diffusion import train as m2m
from learning.translation.diffusion.network import KIND as M2M
from learning.translation.diffusion.network import MARKER_VAE as VAE
from learning.translation.diffusion.network import load_vae_adapter
from learning.translation.diffusion.train_vae import train_vae
from learning.translation.diffusion.weights import (
    BASE,
    fingerprint,
    read_unet,
    read_vae,
    vendor,
)
from learning.translation.field import train as field
from learning.translation.field.data import gather_role
from learning.translation.loading import load_translator
from learning.translation.translator import SensorView, for_pair
from recorder import MarkerArchive
from recorder.processes import cores

# Seed of all trainings; there is one run of each.
SEED = 0
# Methods whose nets see a press in order, and each frame alone.
OWN, ALONE = "own labels", "own labels, each frame alone"
MEMORY_NETS = ("paper", "tiny", "displacement")
# Steps, and epochs, that are timed before a training, until they take some time [s].
PROBE, PROBED_EPOCHS, ENOUGH_S = 12, 1, 1.5
# Steps, and epochs, of a training that has no time.
FEW = 4
Rows = list[dict[str, Any]]
Jobs = dict[str, Callable[[], dict[str, Rows]]]
Train = Callable[[int, TrainingSession], object]


@dataclass(frozen=True, eq=False)
class Chain(Study):
    """Sensors, patterns, and the time of trainings."""

    size: Size
    minutes: float
    patterns: MarkerArchive | None
    """States of one gel under many patterns."""

    @property
    def base(self) -> Path:
        """Folder of the untrained networks."""
        return self.folder / "base"

    @property
    def patterns_split(self) -> Split:
        """Presses of the patterns, of which some are held out."""
        assert self.patterns is not None
        out = self.size.held_out_patterns
        return make_split(self.patterns, validation=0, new_press=0, held_out_sensors=out)

    def seconds(self, kind: str) -> float:
        """Training time of a kind of network [s]."""
        return 60 * self.minutes * self.size.shares[kind]


def begin(run: Run, folder: Path, size: Size, minutes: float) -> Chain:
    """Simulate what is not simulated yet, and return the surroundings of all jobs."""
    plans = dict(size.plans)
    if size.patterns:
        plans["patterns"] = size.states
    paths = {name: folder / f"{name}.markers.zarr" for name in plans}
    for done, (name, plan) in enumerate(plans.items()):

        def inside(fraction: float, done: int = done) -> None:
            run.progress(0.4 * (done + fraction) / len(plans))

        simulate(paths[name], plan, run.device, cores(), inside)
    archive = Joined([path for name, path in paths.items() if name != "patterns"])
    held_out = size.held_out
    split = make_split(archive, validation=0, new_press=0, held_out_sensors=held_out)
    return Chain(
        folder=folder,
        archive=archive,
        split=split,
        device=torch.device(run.device),
        processes=max(1, cores() // 2),
        skins_differ=size.skins_differ,
        size=size,
        minutes=minutes,
        patterns=MarkerArchive(paths["patterns"]) if size.patterns else None,
    )


def measured(run: Run, folder: Path, size: Size, minutes: float) -> dict[str, Any]:
    """Train and score the chain and its baselines; return rows of forces, images and patterns."""
    chain = begin(run, folder, size, minutes)
    jobs: Jobs = {f"own {name}": partial(own, chain, name) for name in size.trained}
    jobs["translators"] = partial(translators, chain)
    if chain.patterns is not None:
        jobs["patterns"] = partial(patterns, chain)
    for name in size.translators:
        jobs |= {f"pairs {name} {one}": partial(pairs, chain, name, one) for one in size.trained}
    return run_jobs(run, chain, jobs)


def measured_memory(run: Run, folder: Path, size: Size, minutes: float) -> dict[str, Any]:
    """Train nets with the frames of a press in order and each alone; return rows of forces."""
    chain = begin(run, folder, size, minutes)
    nets = MEMORY_NETS if chain.device.type == "cuda" else MEMORY_NETS[1:]
    jobs: Jobs = {
        f"memory {preset} {name}": partial(memory, chain, preset, name)
        for name in size.trained
        for preset in nets
    }
    return run_jobs(run, chain, jobs)


def run_jobs(run: Run, chain: Chain, jobs: Jobs) -> dict[str, Any]:
    """Do each job once, and return the rows of all by table, with the time of each training."""
    tables: dict[str, Any] = {}
    for done, (name, job) in enumerate(jobs.items()):
        run.progress(0.4 + 0.6 * done / len(jobs))
        for table, rows in once(chain.folder, name, job).items():
            tables.setdefault(table, []).extend(rows)
    tables["seconds"] = {
        path.stem: json.loads(path.read_text(encoding="utf-8"))["seconds"]
        for path in sorted((chain.folder / "models").glob("*.json"))
    }
    tables["held out"] = [*chain.size.held_out, *chain.size.held_out_patterns]
    run.seeds = (SEED,)
    run.spread = "one training of each; 90 % intervals by drawing the test indenters again"
    return tables


# Trainings that have a time


def fitting(
    study: Study, name: str, seconds: float, launch: Any, train: Train, probe: int = PROBE
) -> int:
    """Return the number of steps, or epochs, that fit in some time.

    Args:
        study: Surroundings.
        name: Name of the network, beside whose folder the number is stored.
        seconds: The time [s]; 0: a few steps.
        launch: Device and precision.
        train: Trains a given number of steps, in memory.
        probe: Steps, or epochs, that are timed at first.
    """
    stored = study.model(name).with_suffix(".json")
    if stored.exists():
        return int(json.loads(stored.read_text(encoding="utf-8"))["steps"])
    steps = FEW
    if seconds:
        each = _seconds_of_one(probe, launch, train)
        steps = max(2, int(seconds / each))
        seconds = steps * each
    stored.parent.mkdir(parents=True, exist_ok=True)
    stored.write_text(json.dumps({"steps": steps, "seconds": round(seconds, 1)}), encoding="utf-8")
    return steps


def _seconds_of_one(units: int, launch: Any, train: Train) -> float:
    """Return the time of one step, or of one epoch, of a training that is timed."""
    while True:
        stamps: dict[int, float] = {}

        def stamp(done: int, _: int, stamps: dict[int, float] = stamps) -> None:
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            stamps[done] = time.perf_counter()

        train(units, TrainingSession(accelerator(launch), progress=stamp))
        if len(stamps) >= 4:
            # Medians of both halves: a start, or work between two stages, is no step.
            halves = np.array_split(np.diff(list(stamps.values())), 2)
            seconds = float(np.mean([np.median(each) for each in halves])) * len(stamps)
            if seconds > ENOUGH_S:
                return seconds / units
        units *= 4


def trained(study: Study, name: str, kind: str, settings: Any, train: Train, data: str) -> None:
    """Train a network in its folder, unless it is there; a stopped one goes on."""
    based = {BASE: fingerprint(str(study.folder / "base"))} if kind in (VAE, M2M) else None
    run = RunFolder.open(study.model(name), kind, settings, data, metadata=based)
    if not run.finished:
        with session_of(run, settings.launch, f"steps of {name}") as session:
            train(0, session)


# Marker VAE and translators


def write_base(folder: Path, size: Size) -> None:
    """Write untrained networks in the layout of the published ones, the same each time."""
    if (folder / "unet" / "config.json").exists():
        return
    diffusers = vendor("diffusers")
    with torch.random.fork_rng():
        torch.manual_seed(SEED)
        for name, kind, config in (
            ("vae", diffusers.AutoencoderKL, size.vae),
            ("unet", diffusers.UNet2DConditionModel, size.unet),
        ):
            kind.from_config(config).save_pretrained(folder / name)


def translators(chain: Chain) -> dict[str, Rows]:
    """Train the marker VAE, the translator between patterns and between sensors, and `field`."""
    if "m2m" in chain.size.translators:
        train_chain(chain)
    train_field(chain, chain.size.field_preset, chain.seconds("field"))
    return {}


def train_chain(chain: Chain) -> None:
    """Train the marker VAE, then the paper's translator between patterns and between sensors."""
    write_base(chain.base, chain.size)
    train_marker_vae(chain)
    adapter = load_vae_adapter(chain.model("vae"), fingerprint(str(chain.base)))
    begun: dict[str, Any] = {"vae_adapter": adapter}
    rate = 3e-4
    if chain.patterns is not None:
        train_m2m(chain, "m2m-patterns", chain.patterns, chain.patterns_split, rate, **begun)
        begun = {"start_from": read_model_folder(chain.model("m2m-patterns"), M2M).weights()}
        rate = 2e-4
    train_m2m(chain, "m2m", chain.archive, chain.split, rate, **begun)


def _diffusion(chain: Chain, rate: float, steps: int) -> m2m.TranslatorSettings:
    """Return the paper's settings without the losses that need published weights."""
    size, warm = chain.size, min(200, steps // 10)

    def cosine(rate: float) -> str:
        return f"{{rate: {{kind: cosine, rate: {rate}, steps: {steps}, warm_up: {warm}}}}}"

    overrides = [
        "whole=true",
        f"steps={steps}",
        f"batch={size.batch}",
        f"seed={SEED}",
        chain.launch,
        f"launch.mixed_precision={size.precision}",
        f"checkpoint_every={max(1, steps // 4)}",
        f"validate_every={steps}",
        f"weights.base={json.dumps(str(chain.base))}",
        f"optimiser={cosine(rate)}",
        "sample_latents=false",
        "conditioning=channel_tokens",
        "source_reference=false",
        "losses={adversarial: 0, perceptual: 0, square: 1}",
        f"marker_vae={{steps: {steps}, batch: {size.batch}, optimiser: {cosine(1e-3)}, "
        f"mixed_precision: {size.precision}}}",
    ]
    return read_settings(m2m.TranslatorSettings, m2m.PRESETS, "paper_main", overrides)


def train_marker_vae(chain: Chain) -> None:
    """Train the marker VAE on the frames of all sensors and patterns."""
    if (chain.model("vae") / "model.safetensors").exists():
        return
    data = [(chain.archive, chain.split)]
    if chain.patterns is not None:
        data.append((chain.patterns, chain.patterns_split))
    parts = []
    for archive, split in data:
        sensors = [archive[name] for name in split.trained_sensors(archive)]
        rows = [split.rows(each.table, "train") for each in sensors]
        parts.append(read_frames_of(sensors, rows, chain.device))
    images = torch.cat(parts)
    base = str(chain.base)

    def train(steps: int, session: TrainingSession) -> None:
        own = _diffusion(chain, 1e-3, steps or known).of_marker_vae()
        train_vae(images, read_vae(base), own, None, session)

    launch = _diffusion(chain, 1e-3, PROBE).of_marker_vae().launch
    known = fitting(chain, "vae", chain.seconds("vae"), launch, train)
    trained(chain, "vae", VAE, _diffusion(chain, 1e-3, known).of_marker_vae(), train, "frames")


def train_m2m(
    chain: Chain, name: str, archive: MarkerArchive, split: Split, rate: float, **begun: Any
) -> None:
    """Train the paper's translator on the location pairs of an archive's sensors."""
    if (chain.model(name) / "model.safetensors").exists():
        return
    rows = paired_rows(archive, split, split.trained_sensors(archive), "train")
    frames = read_paired(archive, rows, device=chain.device)

    def train(steps: int, session: TrainingSession) -> None:
        networks = m2m.Pretrained(read_unet(str(chain.base)), read_vae(str(chain.base)))
        own = _diffusion(chain, rate, steps or known)
        m2m.train(frames, networks, own, None, session, **begun)

    launch = _diffusion(chain, rate, PROBE).launch
    known = fitting(chain, name, chain.seconds(name), launch, train)
    trained(chain, name, M2M, _diffusion(chain, rate, known), train, archive.name)


def train_field(
    study: Study, preset: Sequence[str], seconds: float, name: str = "field", seed: int = SEED
) -> None:
    """Train the field translator on the same frames, without a simulator's true displacement.

    `preset` is that of its settings, and overrides.
    """
    if (study.model(name) / "model.safetensors").exists():
        return
    sensors = study.split.trained_sensors(study.archive)
    frames = gather_role(study.archive, study.split, sensors, "train", device=study.device)
    if frames is None:
        raise LearningError(f"{study.archive.name}: no press to train on; allowed: some")
    without = replace(frames, shift=None)

    def settings(steps: int) -> field.FieldSettings:
        half = [f"{stage}.steps={max(1, steps // 2)}" for stage in ("field_stage", "map_stage")]
        own = [f"seed={seed}", f"validate_every_steps={steps}", study.launch]
        overrides = [*preset[1:], *half, *own]
        return read_settings(field.FieldSettings, field.PRESETS, preset[0], overrides)

    def train(steps: int, session: TrainingSession) -> None:
        field.train_field(without, settings(steps or known), None, session)

    known = fitting(study, name, seconds, settings(PROBE).launch, train)
    trained(study, name, "field", settings(known), train, "frames")


# Force nets


def net(
    chain: Chain,
    preset: str,
    name: str,
    presses: Presses,
    start_from: ForceModel | None = None,
    compensation: PairCompensation | None = None,
    overrides: Sequence[str] = (),
) -> ForceModel:
    """Return a force net, trained for its time if it is not there; from another's weights if given.

    A preset's stages get equal parts of the time; a net that goes on has only its last.
    """
    labelled = presses if compensation is None else compensated(compensation).of(presses)

    def settings(epochs: int) -> ForceModelSettings:
        own = [f"seed={SEED}", "patience_epochs=null", chain.launch]
        if chain.device.type == "cuda":
            own += RECIPES.get(preset, ())
        whole = read_settings(ForceModelSettings, NET_PRESETS, preset, [*own, *overrides])
        stages = whole.stages if start_from is None else whole.stages[-1:]
        count = max(1, epochs // len(stages))
        short = tuple(shortened(stage, count, len(labelled), whole) for stage in stages)
        return replace(whole, stages=short)

    def train(epochs: int, session: TrainingSession) -> None:
        train_force(labelled, settings(epochs or known), session, start_from=start_from)

    if not (chain.model(name) / "model.safetensors").exists():
        seconds = chain.seconds("net" if start_from is None else "tuned")
        launch = settings(PROBE).launch
        known = fitting(chain, name, seconds, launch, train, PROBED_EPOCHS)
        trained(chain, name, FORCE, settings(known), train, labelled.sensor)
    return load_force_model(chain.model(name), chain.device)


def force_row(
    chain: Chain, method: str, preset: str, ends: tuple[str, str], predicted: Any
) -> dict[str, Any]:
    """Return the errors of forces on a target's unseen indenters, with intervals over indenters."""
    source, target = ends
    true, indenter = chain.true_forces(target)
    scores = force_scores(true, predicted, indenter, SEED)
    return {"method": method, "net": preset, "source": source, "target": target, **scores}


def own(chain: Chain, sensor: str) -> dict[str, Rows]:
    """Train a sensor's own nets, and predict for all targets without a translator."""
    targets = [name for name in chain.archive if name != sensor]
    rows = []
    for preset in dict.fromkeys((chain.size.net, "displacement")):
        form = form_of(preset)
        presses = chain.presses(sensor, "train", form)
        model = net(chain, preset, f"{preset}-{sensor}", presses)
        predicted = model.predict(chain.unseen(sensor, form))
        rows.append(force_row(chain, OWN, preset, (sensor, sensor), predicted))
        for target in targets:
            used, labels = model, chain.relabelling(sensor, target)
            if preset == "displacement" and labels is not None:
                name = f"{preset}-{sensor}-for-{target}"
                used = net(chain, preset, name, presses, model, labels)
            method = "displacement" if preset == "displacement" else "source-only"
            predicted = used.predict(chain.unseen(target, form))
            rows.append(force_row(chain, method, preset, (sensor, target), predicted))
    for target in targets:
        predicted = nearest_labels(chain, sensor, target)
        rows.append(force_row(chain, NEAREST, "-", (sensor, target), predicted))
    return {"forces": rows}


def memory(chain: Chain, preset: str, sensor: str) -> dict[str, Rows]:
    """Train a net on a sensor's own labels, with the frames of a press in order and each alone."""
    form, of_a_press = form_of(preset), frames_of_a_press(chain.archive)
    batch = read_settings(ForceModelSettings, NET_PRESETS, preset, []).sequences.batch
    alone = ("input.alone=true", f"sequences.batch={batch * of_a_press}")
    presses, rows = chain.presses(sensor, "train", form), []
    for method, ending, overrides in ((OWN, "", ()), (ALONE, "-alone", alone)):
        model = net(chain, preset, f"{preset}-{sensor}{ending}", presses, overrides=overrides)
        predicted = model.predict(chain.unseen(sensor, form))
        rows.append(force_row(chain, method, preset, (sensor, sensor), predicted))
    return {"forces": rows}


def pairs(chain: Chain, name: str, source: str) -> dict[str, Rows]:
    """Score a translator's images of unseen indenters, and nets that are trained on its frames."""
    size, archive = chain.size, chain.archive
    translator = load_translator(chain.model(name), chain.device)
    start = load_force_model(chain.model(f"{size.net}-{source}"), chain.device)
    packed = chain.presses(source, "train", "packed")
    images, forces = [], []
    for target in (each for each in archive if each != source):
        views = SensorView.of(archive[source]), SensorView.of(archive[target])
        of_pair = for_pair(translator, *views)
        images += image_rows(chain, name, (source, target), of_pair, size.scored)
        look = look_of(archive[target], packed, chain.device)
        frames = translate_presses(packed, look, of_pair)
        tuned_name = f"{size.net}-{source}-to-{target}-{name}"
        labels = chain.relabelling(source, target)
        tuned = net(chain, size.net, tuned_name, frames, start, labels)
        predicted = tuned.predict(chain.unseen(target))
        forces.append(force_row(chain, name, size.net, (source, target), predicted))
    return {"images": images, "forces": forces}


def patterns(chain: Chain) -> dict[str, Rows]:
    """Score all pairs of patterns before and after translation, under unseen indenters."""
    assert chain.patterns is not None
    translator = load_translator(chain.model("m2m-patterns"), chain.device)
    archive, split, scored = chain.patterns, chain.patterns_split, chain.size.scored
    return {"patterns": [*pattern_rows(archive, split, translator, scored, chain.device)]}
