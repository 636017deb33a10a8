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
from learning.markers.segment import CameraPreset, Segmenter, TaxelPreset, preset
from learning.transfer.score import new_frames, score_of
from recorder import MarkerArchive
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan
from recorder.markers import pack
from rig.bench.pair import FINGERS, GraspObject, PairSpec
from rig.bench.worlds import Noise, WorldSpec
from rig.mock.world.pair import PairWorld
from sim.indenters import NAMES

PAIRS = (("gelsight", "gelsight"), ("uskin", "uskin"), ("gelsight", "uskin"))
PRESETS = {"gelsight": "bench-gelsight", "uskin": "uskin"}
# Closing of a step [m], mass of every object [kg], its width [m], and the axes with labels.
STEP, MASS, WIDTH, FZ = 0.3e-3, 0.3, 0.04, np.where(np.arange(6) == 2, 1.0, np.nan)
OBJECTS, UNSEEN, STEPS = 30, 8, 7


def measure(run: Run) -> dict[str, Any]:
    """Squeeze objects between skins of each pair, and learn the forces of the right one."""
    run.seeds, run.spread, results = (0,), "one set of objects", {}
    for pair in PAIRS[: 1 if run.quick else None]:
        name, folder = " and ".join(pair), folder_of(run, "gauge-balance") / "-".join(pair)
        results[name] = run.once(name, partial(of_pair, folder, pair, run.quick))
        run.progress(len(results) / len(PAIRS))
    return results


def of_pair(folder: Path, sensors: tuple[str, str], quick: bool) -> dict[str, list[str]]:
    """Return errors and coverage on objects that no stage saw; the right finger has no label."""
    count, ways, results = 6 if quick else OBJECTS, ("ridge", "kernel"), {}
    gauge = squeezed(folder / "gauge", sensors, range(count), 0)["left"]
    pair = squeezed(folder / "pair", sensors, range(count), 1)
    tested = squeezed(folder / "unseen", sensors, range(OBJECTS, OBJECTS + UNSEEN), 2)["right"]
    first = Request(gauge, folder / "first", ways=ways, unseen=())
    run_choice(first, own_labels(first, None))
    origins = ("the other's model", str(first.out)), ("weights alone", None)
    for name, model in origins[: 1 if quick else 2]:
        one = Request(pair["right"], folder / name.replace(" ", "-"), ways=ways, unseen=())
        given = one, pair["left"]
        run_choice(one, by_model(*given, model, print) if model else by_weights(*given, print))
        score = score_of(new_frames(one.out, tested))
        figures = score.errors.r2[2], score.errors.mae[2], score.width[2], score.covered[2]
        results[name] = [f"{figure:.3f}" for figure in figures]
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

    for squeeze, (number, turn) in enumerate(product(objects, (1, -1))):
        world.place(GraspObject("object", (faces[number][0], faces[number][1]), WIDTH, MASS))
        for step in range(STEPS + 1):
            closing = STEP * step * random.uniform(0.9, 1.1) if step else -4e-3
            for _ in range(20):
                t_ns += 100_000_000
                state = world.step(t_ns, WIDTH - closing, (turn, 0, 0), step > 0)
            for side in (0, 1):
                seen[side].append((read(side), None if step else read(side), state.wrench[side]))
            rows.append((number, squeeze, step, t_ns, turn))
    both = zip(FINGERS, sensors, seen, strict=True)
    return {finger: archived(folder, finger, name, some, rows) for finger, name, some in both}


def archived(
    folder: Path, finger: str, sensor: str, seen: list[Any], rows: list[Any]
) -> SensorSelection:
    """Write the frames of a finger, each squeeze with its own reference; return them."""
    path, settings = folder / f"{finger}.markers.zarr", preset(PRESETS[sensor])
    number, squeeze, step, t_ns, turn = np.array(rows).T
    signals, rests = [one for one, *_ in seen], [rest for _, rest, _ in seen if rest is not None]
    if isinstance(settings, TaxelPreset):
        masks = taxel_masks(np.array(signals), np.array(rests)[squeeze], settings)
        references = taxel_masks(np.array(rests), np.array(rests), settings)
    else:
        assert isinstance(settings, CameraPreset)
        segmenter = Segmenter(settings)
        masks, references = (
            np.array([segmenter.mask_of_view(segmenter.view(one)) for one in some])
            for some in (signals, rests)
        )
    objects, count = tuple(f"object-{k}" for k in range(number.max() + 1)), len(rows)
    scale, own = settings.mm_per_px or 1.0, {"finger": finger}
    plan = SensorPlan(sensor, count, 8, 8 * count, pack(references), scale, attrs=own)
    path.parent.mkdir(parents=True, exist_ok=True)
    writer, ones = ArchiveWriter.begin(path, ArchivePlan((plan,), objects)), np.ones(count, bool)
    columns = {"indenter": number, "location": squeeze, "target": squeeze, "frame": step}
    columns |= {"phase": 0 * step - 1, "depth": STEP * step, "t_ns": t_ns, "reference": squeeze}
    columns |= {"seen": ones, "valid": ones, "position": np.zeros((count, 2))}
    columns["wrench"] = np.array([wrench for *_, wrench in seen]) * FZ
    known = {"session": "squeezes", "run": 0, "mass": MASS, "still": True}
    steps = zip(step.tolist(), turn.tolist(), strict=True)
    source = [json.dumps({**known, "turn": [x, 0, 0], "step": k}) for k, x in steps]
    writer.sensors[sensor].write(0, packed=pack(masks), table=columns, source=source)
    writer.finish()
    return SensorSelection(MarkerArchive(path), sensor, sensor)


def section(values: dict[str, Any], page: Page) -> str:
    """Return the table of pairs and ways."""
    del page
    head = ["fingers", "right finger by", "R2 of Fz", "MAE [N]", "interval +- [N]", "coverage"]
    lines = [[pair, way, *row] for pair, ways in values.items() for way, row in ways.items()]
    return f"""## By balance, between two fingers

Objects of {1e3 * MASS:g} g with another paper indenter on either side, in {STEPS} steps, with one
finger below and then the other. The right finger has no label; Fz on {UNSEEN} unseen objects.

{table(head, lines)}"""
