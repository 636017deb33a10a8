"""Normal forces of a finger by balance: by the other finger's model, and by known weights alone."""

import json
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.study import folder_of
from benchmarks.report import Page, Run, table
from learning.choice.balance import by_model, by_weights
from learning.choice.run import Request, own_labels, run_choice
from learning.data.matching import SensorSelection
from learning.markers.frames import taxel_masks
from learning.markers.pattern import with_reference
from learning.markers.segment import CameraPreset, Segmenter, TaxelPreset, preset
from learning.transfer.score import new_frames, score_of
from recorder import MarkerArchive
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan
from recorder.markers import pack
from rig.bench.pair import FINGERS, GraspObject, PairSpec
from rig.bench.worlds import Noise, WorldSpec
from rig.mock.world.pair import PairWorld
from sim.indenters import NAMES

PAIRS = {
    "two GelSights": ("gelsight", "gelsight"),
    "two uSkins": ("uskin", "uskin"),
    "one of each": ("gelsight", "uskin"),
}
PRESETS = {"gelsight": "bench-gelsight", "uskin": "uskin"}
# Closing of a step [m], mass of every object [kg], and its width [m].
STEP, MASS, WIDTH = 0.3e-3, 0.3, 0.04
FZ_ALONE = np.where(np.arange(6) == 2, 1.0, np.nan)
OBJECTS, UNSEEN, STEPS, SQUEEZES = 30, 8, 7, 1


def measure(run: Run) -> dict[str, Any]:
    """Squeeze objects between skins of each pair, and learn the forces of the right one."""
    run.seeds, run.spread = (0,), "one set of objects"
    results = {}
    for name in PAIRS:
        folder = folder_of(run, "gauge-balance") / name.replace(" ", "-")
        results[name] = run.once(name, partial(of_pair, folder, PAIRS[name], run.quick))
        run.progress(len(results) / len(PAIRS))
    return results


def of_pair(folder: Path, sensors: tuple[str, str], quick: bool) -> dict[str, list[str]]:
    """Return errors and coverage on objects that no stage saw; the right finger has no label."""
    count, ways = 6 if quick else OBJECTS, ("ridge", "kernel")
    gauge = squeezed(folder / "gauge", sensors, range(count), 0)["left"]
    pair = squeezed(folder / "pair", sensors, range(count), 1)
    tested = squeezed(folder / "unseen", sensors, range(OBJECTS, OBJECTS + UNSEEN), 2)["right"]
    first = Request(gauge, folder / "first", ways=ways, unseen=())
    run_choice(first, own_labels(first, None))
    source, results = pair["left"], {}
    for name in ("the other's model", "weights alone"):
        one = Request(pair["right"], folder / name.replace(" ", "-"), ways=ways, unseen=())
        model = str(first.out) if name == "the other's model" else None
        by = by_model(one, source, model, print) if model else by_weights(one, source, print)
        run_choice(one, by)
        score = score_of(new_frames(one.out, tested))
        figures = score.errors.r2[2], score.errors.mae[2], score.width[2], score.covered[2]
        results[name] = [f"{float(figure):.3f}" for figure in figures]
    return results


def squeezed(
    folder: Path, sensors: tuple[str, str], objects: range, seed: int
) -> dict[str, SensorSelection]:
    """Squeeze objects with the right finger below and above; return the archive of each finger."""
    left, right = (WorldSpec(name, noise=Noise(grey=1.0)) for name in sensors)
    world, random, t_ns = PairWorld(PairSpec(left, right)), np.random.default_rng(seed), 0
    faces = np.random.default_rng(9).permutation([*product(NAMES, NAMES)])
    rows: list[Any] = []
    seen: tuple[list[Any], list[Any]] = ([], [])

    def read(side: int) -> Any:
        noise = random.normal(0, 2.1, (16, 3))
        return world.reading(side) + (noise if sensors[side] == "uskin" else 0)

    for squeeze, (number, turn, _) in enumerate(product(objects, (1, -1), range(SQUEEZES))):
        world.place(GraspObject("object", (faces[number][0], faces[number][1]), WIDTH, MASS))
        for step in range(STEPS + 1):
            closing = STEP * step * random.uniform(0.9, 1.1) if step else -4e-3
            for _ in range(20):
                t_ns += 100_000_000
                state = world.step(t_ns, WIDTH - closing, (turn, 0, 0), step > 0)
            for side in (0, 1):
                seen[side].append(
                    (read(side), read(side) if not step else None, state.wrench[side])
                )
            rows.append((number, squeeze, step, t_ns, turn))
    return {
        finger: archived(folder / f"{finger}.markers.zarr", name, finger, rows, some)
        for finger, name, some in zip(FINGERS, sensors, seen, strict=True)
    }


def archived(
    path: Path, sensor: str, finger: str, rows: list[Any], seen: list[Any]
) -> SensorSelection:
    """Write the frames of a finger, each squeeze with its own reference; return them."""
    number, squeeze, step, t_ns, turn = np.array(rows).T
    settings, rests = preset(PRESETS[sensor]), [rest for _, rest, _ in seen if rest is not None]
    of = np.repeat(np.arange(len(rests)), STEPS + 1)
    if isinstance(settings, TaxelPreset):
        masks = taxel_masks(np.array([one for one, *_ in seen]), np.array(rests)[of], settings)
        references = taxel_masks(np.array(rests), np.array(rests), settings)
    else:
        assert isinstance(settings, CameraPreset)
        segmenter = Segmenter(settings)
        views = [segmenter.view(rest) for rest in rests]
        finders = [with_reference(segmenter, view) for view in views]
        references = np.array([segmenter.mask_of_view(view) for view in views])
        seen_as = [
            finders[k].mask_of_view(segmenter.view(one[0])) for k, one in zip(of, seen, strict=True)
        ]
        masks = np.array(seen_as)
    packed, objects = pack(masks), tuple(f"object-{k}" for k in range(number.max() + 1))
    scale = settings.mm_per_px or 0.0249
    plan = SensorPlan(
        sensor, len(rows), STEPS + 1, len(rows), pack(references), scale, attrs={"finger": finger}
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    writer, zeros = ArchiveWriter.begin(path, ArchivePlan((plan,), objects)), np.zeros(len(rows))
    columns = {"indenter": number, "location": squeeze, "target": squeeze, "frame": step}
    columns |= {"phase": step * 0 - 1, "depth": zeros + STEP * step, "t_ns": t_ns, "reference": of}
    known = {"session": "squeezes", "run": 0, "mass": MASS, "still": True}
    writer.sensors[sensor].write(
        0,
        packed=packed,
        table={
            **columns,
            "seen": zeros == 0,
            "valid": zeros == 0,
            "position": np.zeros((len(rows), 2)),
            "wrench": np.array([wrench for *_, wrench in seen]) * FZ_ALONE,
        },
        source=[
            json.dumps({**known, "turn": [int(x), 0, 0], "step": int(k), "target": int(s)})
            for s, k, x in zip(squeeze, step, turn, strict=True)
        ],
    )
    writer.finish()
    return SensorSelection(MarkerArchive(path), sensor, sensor)


def section(values: dict[str, Any], page: Page) -> str:
    """Return the table of pairs and ways."""
    del page
    head = ["fingers", "right finger by", "R2 of Fz", "MAE [N]", "interval +- [N]", "coverage"]
    lines = [[pair, way, *row] for pair, ways in values.items() for way, row in ways.items()]
    return f"""## By balance, between two fingers

Objects of {1e3 * MASS:g} g with another paper indenter on each side, squeezed in {STEPS} steps with
one finger below and then the other. The right finger has no label; normal force on {UNSEEN} objects
that no stage saw.

{table(head, lines)}"""
