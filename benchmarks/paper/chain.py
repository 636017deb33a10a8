"""The paper's chain from nothing: marker VAE, one-step translator, force nets on its frames.

Trainings have a time, not a number of steps: some steps are timed first, and as many are done as
fit. Beside the chain: the field translator without a simulator's true displacement, the nearest
frame, a net of marker displacement without a translator, the source's net as it is.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.paper.scores import force_scores, pattern_rows
from benchmarks.paper.sizes import PATTERNS, SIZES, Size, quick
from benchmarks.paper.study import (
    PAPER_RECIPE,
    PROBE,
    PROBED_EPOCHS,
    Joined,
    Study,
    folder_of,
    form_of,
    nearest_labels,
    net_settings,
    simulate,
    timed,
    train_net,
)
from benchmarks.report import Run
from learning.config import read_settings
from learning.data.pairs import paired_rows, read_paired
from learning.data.presses import Presses, read_frames_of
from learning.data.splits import Split, make_split
from learning.evaluation.translation import NEAREST
from learning.force.labels import Relabelling
from learning.force.model import ForceModel
from learning.training.run import TrainingSession
from learning.translation.diffusion.network import MarkerToMarker, vae_adapter_of
from learning.translation.diffusion.train import PRESETS, Pretrained, TranslatorSettings, train
from learning.translation.diffusion.train_vae import train_vae
from learning.translation.diffusion.translator import DiffusionTranslator
from learning.translation.diffusion.weights import vendor
from learning.translation.translator import Translator
from recorder import MarkerArchive
from recorder.progress import span_of

OWN = "own labels"
# Most frames of a pair of patterns whose images are scored.
SCORED = 150
Rows = list[dict[str, Any]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain(Study):
    """Sensors, patterns, and trained networks."""

    size: Size
    patterns: MarkerArchive | None
    """States of one gel under many patterns."""
    nets: dict[str, ForceModel] = field(default_factory=dict)
    """Force nets of the sensors' own labels."""

    @property
    def patterns_split(self) -> Split:
        """Presses of the patterns, of which some are held out."""
        assert self.patterns is not None
        out = self.size.held_out_patterns
        return make_split(self.patterns, validation=0, new_press=0, held_out_sensors=out)

    def untrained(self) -> Pretrained:
        """Return the networks that trainings begin with, the same each time."""
        diffusers = vendor("diffusers")
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            vae = diffusers.AutoencoderKL.from_config(self.size.vae)
            return Pretrained(diffusers.UNet2DConditionModel.from_config(self.size.unet), vae)

    @cached_property
    def vae_adapter(self) -> dict[str, torch.Tensor]:
        """Weights of the marker VAE, trained on the frames of all sensors and patterns."""
        data = [(self.archive, self.split)]
        if self.patterns is not None:
            data.append((self.patterns, self.patterns_split))
        parts = []
        for archive, split in data:
            sensors = [archive[name] for name in split.trained_sensors(archive)]
            rows = [split.rows(each.table, "train") for each in sensors]
            parts.append(read_frames_of(sensors, rows, self.device))
        images = torch.cat(parts)

        def fit(steps: int, session: TrainingSession) -> Any:
            settings = self.m2m_settings(1e-3, steps).of_marker_vae()
            return train_vae(images, self.untrained().vae, settings, None, session)

        launch = self.m2m_settings(1e-3, PROBE).of_marker_vae().launch
        return vae_adapter_of(timed(self.size.seconds["vae"], launch, fit).state_dict())

    @cached_property
    def between_patterns(self) -> MarkerToMarker:
        """The paper's translator, trained on the patterns alone."""
        assert self.patterns is not None
        data = self.patterns, self.patterns_split
        return self.trained_m2m("m2m-patterns", *data, 3e-4, vae_adapter=self.vae_adapter)

    @cached_property
    def m2m(self) -> Translator:
        """The paper's translator between sensors."""
        begun: dict[str, Any] = {"vae_adapter": self.vae_adapter}
        if self.patterns is not None:
            begun = {"start_from": self.between_patterns.state_dict()}
        rate = 3e-4 if self.patterns is None else 2e-4
        return self.opened(self.trained_m2m("m2m", self.archive, self.split, rate, **begun))

    def opened(self, network: MarkerToMarker) -> Translator:
        """Return a translator of a network, in the precision of `load_translator`."""
        lower = self.device.type == "cuda" and torch.cuda.is_bf16_supported()
        precision = torch.bfloat16 if lower else torch.float32
        return DiffusionTranslator(network, "m2m", precision=precision)

    def trained_m2m(
        self, kind: str, archive: MarkerArchive, split: Split, rate: float, **begun: Any
    ) -> MarkerToMarker:
        """Train the paper's translator on the location pairs of an archive's sensors."""
        rows = paired_rows(archive, split, split.trained_sensors(archive), "train")
        frames = read_paired(archive, rows, device=self.device)

        def fit(steps: int, session: TrainingSession) -> MarkerToMarker:
            settings = self.m2m_settings(rate, steps)
            return train(frames, self.untrained(), settings, None, session, **begun)

        return timed(self.size.seconds[kind], self.m2m_settings(rate, PROBE).launch, fit)

    def m2m_settings(self, rate: float, steps: int) -> TranslatorSettings:
        """Return the paper's settings without the losses that need published weights."""
        warm = min(200, steps // 10)
        batch, precision = (1, "no") if self.quick else (32, "bf16")

        def cosine(rate: float) -> str:
            return f"{{rate: {{kind: cosine, rate: {rate}, steps: {steps}, warm_up: {warm}}}}}"

        overrides = [
            "whole=true",
            f"steps={steps}",
            f"batch={batch}",
            f"seed={self.seed}",
            self.launch,
            f"launch.mixed_precision={precision}",
            f"checkpoint_every={steps}",
            f"validate_every={steps}",
            f"optimiser={cosine(rate)}",
            "sample_latents=false",
            "conditioning=channel_tokens",
            "source_reference=false",
            "losses={adversarial: 0, perceptual: 0, square: 1}",
            f"marker_vae={{steps: {steps}, batch: {batch}, optimiser: {cosine(1e-3)}, "
            f"mixed_precision: {precision}}}",
        ]
        return read_settings(TranslatorSettings, PRESETS, "paper_main", overrides)

    def net(
        self,
        preset: str,
        presses: Presses,
        start_from: ForceModel | None = None,
        labels: Relabelling | None = None,
    ) -> ForceModel:
        """Return a force net that was trained for its time; from another's weights if given.

        A preset's stages get equal parts of the time; a net that goes on has only its last.
        """
        settings = net_settings(self, preset, PAPER_RECIPE if preset == "paper" else ())
        stages = settings.stages if start_from is None else settings.stages[-1:]

        def fit(epochs: int, session: TrainingSession) -> ForceModel:
            each = max(1, epochs // len(stages))
            return train_net(presses, settings, stages, each, start_from, labels, session)

        seconds = self.size.seconds["net" if start_from is None else "tuned"]
        return timed(seconds, settings.launch, fit, PROBED_EPOCHS)

    @property
    def preset(self) -> str:
        """Force net that is trained on translated frames."""
        return "tiny" if self.quick else "paper"

    def own(self, preset: str, sensor: str) -> ForceModel:
        """Return the net of a sensor's own labels."""
        name = f"{preset}-{sensor}"
        if name not in self.nets:
            self.nets[name] = self.net(preset, self.presses(sensor, "train", form_of(preset)))
        return self.nets[name]

    def row(
        self, method: str, preset: str, ends: tuple[str, str], predicted: NDArray[np.float64]
    ) -> dict[str, Any]:
        """Return the errors on a target's unseen indenters, with intervals over indenters."""
        source, target = ends
        true, indenter = self.true_forces(target)
        scores = force_scores(true, predicted, indenter, self.seed)
        return {"method": method, "net": preset, "source": source, "target": target, **scores}


def begin(run: Run, folder: Path, size: Size) -> Chain:
    """Simulate archives that are not there yet, and return the surroundings of all jobs."""
    archives = {}
    for done, (name, plan) in enumerate(size.plans.items()):
        progress = span_of(run.progress, 0.4 * done / len(size.plans), 0.4 / len(size.plans))
        archives[name] = simulate(folder / f"{name}.markers.zarr", plan, run, progress)
    patterns = archives.pop(PATTERNS, None)
    joined = Joined([archive.path for archive in archives.values()])
    return Chain(
        joined,
        make_split(joined, validation=0, new_press=0, held_out_sensors=size.held_out),
        torch.device(run.device),
        size.skins_differ,
        run.quick,
        field_seconds=size.seconds["field"],
        size=size,
        patterns=joined if size.patterns and patterns is None else patterns,
    )


def measure(part: str, run: Run) -> dict[str, Any]:
    """Train and score the chain and its baselines; return rows of forces and patterns."""
    size = quick(part) if run.quick else SIZES[part]
    chain = begin(run, folder_of(run, f"paper-{part}"), size)
    jobs: dict[str, Callable[[], dict[str, Rows]]] = {
        f"own {name}": partial(without_translator, chain, name) for name in size.sources
    }
    if size.patterns:
        jobs["patterns"] = partial(patterns, chain)
    for name in size.translators:
        jobs |= {f"pairs {name} {one}": partial(pairs, chain, name, one) for one in size.sources}
    tables: dict[str, Any] = {}
    for done, (name, job) in enumerate(jobs.items()):
        run.progress(0.4 + 0.6 * done / len(jobs))
        for table, rows in run.once(name, job).items():
            tables.setdefault(table, []).extend(rows)
    run.seeds = (chain.seed,)
    run.spread = "one training of each; 90 % intervals by drawing the test indenters again"
    return {**tables, "held out": [*size.held_out, *size.held_out_patterns]}


def without_translator(chain: Chain, sensor: str) -> dict[str, Rows]:
    """Train a sensor's own nets, and predict for all targets without a translator."""
    targets = [name for name in chain.archive if name != sensor]
    rows = []
    for preset in dict.fromkeys((chain.preset, "displacement")):
        form, model = form_of(preset), chain.own(preset, sensor)
        predicted = model.predict(chain.unseen(sensor, form))
        rows.append(chain.row(OWN, preset, (sensor, sensor), predicted))
        for target in targets:
            used, labels = model, chain.curves(sensor, target)
            if preset == "displacement" and labels is not None:
                used = chain.net(preset, chain.presses(sensor, "train", form), model, labels)
            method = "displacement" if preset == "displacement" else "source-only"
            predicted = used.predict(chain.unseen(target, form))
            rows.append(chain.row(method, preset, (sensor, target), predicted))
    for target in targets:
        predicted = nearest_labels(chain, sensor, target)
        rows.append(chain.row(NEAREST, "-", (sensor, target), predicted))
    return {"forces": rows}


def pairs(chain: Chain, name: str, source: str) -> dict[str, Rows]:
    """Score nets that are trained on a translator's frames."""
    preset, archive = chain.preset, chain.archive
    translator: Translator = getattr(chain, name)
    start, packed = chain.own(preset, source), chain.presses(source, "train", "packed")
    rows = []
    for target in (each for each in archive if each != source):
        frames = chain.translated(translator, packed, target)
        tuned = chain.net(preset, frames, start, chain.curves(source, target))
        predicted = tuned.predict(chain.unseen(target))
        rows.append(chain.row(name, preset, (source, target), predicted))
    return {"forces": rows}


def patterns(chain: Chain) -> dict[str, Rows]:
    """Score all pairs of patterns before and after translation, under unseen indenters."""
    assert chain.patterns is not None
    translator = chain.opened(chain.between_patterns)
    most = 2 if chain.quick else SCORED
    data = chain.patterns, chain.patterns_split
    return {"patterns": [*pattern_rows(*data, translator, most, chain.device)]}
