"""Mistakes in files, one or more in each kind of file, and the command that reads each.

`make reference` makes `docs/reference/wrong-inputs.md` of them and of what the commands print;
tests/tactile/test_wrong_inputs.py compares the page with what they print now.
"""

import io
import json
import math
import shlex
import shutil
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
# The intact files, in the folder in which commands run.
SESSION, ARCHIVE, PLANNED = "s.zarr", "a.markers.zarr", "planned.markers.zarr"
SPLIT, MODEL = "split.json", "model"
BENCH = f"extends: {ROOT}/rig/bench/benches/gelsight.yaml"
SENSOR = f"extends: {ROOT}/sim/sensors/rows/gelsight.yaml"
MARKERS = f"extends: {ROOT}/learning/markers/presets/bench-gelsight.yaml"
FORCE = f"extends: {ROOT}/learning/force/presets/tiny.yaml"
DEMO = f"extends: {ROOT}/learning/experiment/presets/demo.yaml"
ENTRY = "sessions: [{sensor: uskin, indenter: cone%s}]"
WRONG_SPLIT = (
    '{"format": "tactile-rig split", "format_version": 1, "seed": 0, "validation": 0.2, '
    '"new_press": 0.2, "held_out_sensors": [], "presses": {"train": {"cone": [[0, %s]]}}}'
)

# Mistakes by kind of file: the command, with {} for the file, its suffix, and texts.
TEXTS: dict[str, tuple[str, str, dict[str, str]]] = {
    "bench": (
        "collect --bench {} --out x.zarr",
        ".yaml",
        {
            "key misspelt": f"{BENCH}\nlimits: {{depth_max_m: 1.3}}",
            "unit left out": f"{BENCH}\nlimits: {{depth_max: 1.3}}",
            "metres for millimetres": f"{BENCH}\ntrajectory: {{depth_max_mm: 0.0012}}",
            "ten times as deep": f"{BENCH}\ntrajectory: {{depth_max_mm: 12.0}}",
            "outside the box": f"{BENCH}\ntrajectory: {{step_x_mm: 9.0}}",
            "kind misspelt": f"{BENCH}\ncamera: {{kind: eye, address: x, rate_hz: 30.0}}",
            "not a number": f"{BENCH}\nrate_hz: .nan",
            "unit in the value": f"{BENCH}\nrate_hz: 40 Hz",
            "no for false": f"{BENCH}\nmock: no",
            "key twice": f"{BENCH}\nrate_hz: 40.0\nrate_hz: 30.0",
            "keys missing": "sensor: gelsight",
            "cut short": f"{BENCH}\nlimits: {{depth_max_mm: 1.3",
            "tab": f"{BENCH}\nlimits:\n\tdepth_max_mm: 1.3",
            "empty": "",
            "extended file misspelt": "extends: gelsigt.yaml",
            "a campaign": f"out: day\n{ENTRY % ''}",
        },
    ),
    "campaign": (
        "campaign --file {} --list",
        ".yaml",
        {
            "key misspelt": "session: [{sensor: uskin, indenter: cone}]",
            "sensor misspelt": "sessions: [{sensor: uskim, indenter: cone}]",
            "plan misspelt": ENTRY % ", plan: press",
            "text for a number": ENTRY % ", targets: ten",
            "negative count": ENTRY % ", targets: -1",
            "key missing": "sessions: [{sensor: uskin}]",
            "number as a name": "sessions: [{sensor: uskin, indenter: 5}]",
            "names only": "sessions: [uskin]",
            "key twice": "out: a\nout: b\nsessions: []",
            "a bench": BENCH,
        },
    ),
    "sensor": (
        "sim archive {} --tier layer --scale smoke --out x.markers.zarr",
        ".yaml",
        {
            "key misspelt": f"{SENSOR}\nbody: {{modulus_kp: 200}}",
            "pascals for kilopascals": f"{SENSOR}\nbody: {{modulus_kpa: 200000000}}",
            "metres for millimetres": f"{SENSOR}\nbody: {{thickness_mm: 0.004}}",
            "infinite": f"{SENSOR}\nbody: {{modulus_kpa: .inf}}",
            "out of range": f"{SENSOR}\nbody: {{poisson: 0.7}}",
            "text for a number": f"{SENSOR}\nbody: {{modulus_kpa: soft}}",
            "pattern misspelt": f"{SENSOR}\nsignal: {{patterns: [Circle-V]}}",
            "no for null": f"{SENSOR}\nvariation: {{mount: no}}",
            "key twice": f"{SENSOR}\nbody: {{poisson: 0.4, poisson: 0.45}}",
            "keys missing": "description: ours",
        },
    ),
    "marker preset": (
        f"markers {SESSION} --preset {{}} --out x.markers.zarr",
        ".yaml",
        {
            "unit left out": f"{MARKERS}\narea: [40, 6000]",
            "metres for millimetres": f"{MARKERS}\nmm_per_px: 0.0000249",
            "kind misspelt": f"{MARKERS}\ndetectors: [{{kind: contrst, window_px: 49}}]",
            "range reversed": f"{MARKERS}\narea_px: [6000, 40]",
            "text for a number": f"{MARKERS}\nsmooth_px: three",
            "a sensor": SENSOR,
            "for taxels": f"extends: {ROOT}/learning/markers/presets/uskin.yaml",
        },
    ),
    "training preset": (
        f"train force {ARCHIVE} --sensor dots --split {SPLIT} --preset {{}} --out x",
        ".yaml",
        {
            "key misspelt": f"{FORCE}\nnetwork: {{memmory: 16}}",
            "part of an epoch": f"{FORCE}\nstages: [{{epochs: 1.5, learning_rate: 0.002}}]",
            "not a number": f"{FORCE}\nstages: [{{epochs: 2, learning_rate: .nan}}]",
            "negative": f"{FORCE}\nstages: [{{epochs: 2, learning_rate: -0.002}}]",
            "no for false": f"{FORCE}\ninput: {{imagenet: no}}",
            "choice misspelt": f"{FORCE}\noptimiser: {{name: adamv}}",
            "keys missing": "description: ours",
            "a marker preset": MARKERS,
        },
    ),
    "experiment preset": (
        f"experiment {ARCHIVE} --preset {{}} --out x",
        ".yaml",
        {
            "key misspelt": f"{DEMO}\ntranslator: [flow]",
            "choice misspelt": f"{DEMO}\ntranslators: [flov]",
            "percent for a fraction": f"{DEMO}\nnew_press: 10",
            "text for a list": f"{DEMO}\ntranslators: flow",
            "preset misspelt": f"{DEMO}\nforce: {{preset: tinny}}",
            "setting misspelt": f"{DEMO}\nforce: {{preset: tiny, set: [network.memmory=16]}}",
            "setting without a value": f"{DEMO}\nfine_tuning: [stages]",
        },
    ),
    "split": (
        f"predict {MODEL} {ARCHIVE} --sensor dots --split {{}} --out x.npz",
        ".json",
        {
            "cut short": (WRONG_SPLIT % 5)[:150],
            "newer version": (WRONG_SPLIT % 5).replace('version": 1', 'version": 9'),
            "part missing": (WRONG_SPLIT % 5).replace('"presses"', '"pressed"'),
            "text for a number": WRONG_SPLIT % '"a"',
            "a list": "[1]",
            "a bench": BENCH,
        },
    ),
    "settings": (
        f"train force {ARCHIVE} --sensor dots --split {SPLIT} --preset tiny --out x --set {{}}",
        "",
        {
            "key misspelt": "network.memmory=16",
            "part for a number": "network=16",
            "text for a number": "input.side_px=big",
            "not a number": "optimiser.clip=.nan",
            "no value": "range_margin",
            "choice misspelt": "optimiser.name=adamv",
            "negative": "network.memory=-4",
        },
    ),
}

HOME = "sensor: gelsight\nhome: {cylinder: {shift_mm: 0.1}}"
PLAN = "zarr.json:attributes.plan"
BODY = f"{PLAN}.sensors.0.body"
# Mistakes in copied folders: the command, the folder, its suffix, and changes: a place and its
# value, or the bytes that are left of a file; None deletes it. Without a folder to copy, the only
# file of a new one.
FOLDERS: dict[str, tuple[str, str, str, dict[str, tuple[str, object]]]] = {
    "session": (
        "session info {} --picture x.png",
        SESSION,
        ".zarr",
        {
            "newer version": ("zarr.json:attributes.format_version", 99),
            "other format": ("zarr.json:attributes.format", "photos"),
            "status missing": ("zarr.json:attributes.status", None),
            "frames missing": ("frames", None),
            "cut short": ("zarr.json", 300),
        },
    ),
    "session to resume": (
        "collect --resume {}",
        SESSION,
        ".zarr",
        {
            "plan missing": ("zarr.json:attributes.plan", None),
            "plan misspelt": ("zarr.json:attributes.plan", {"kind": "pres"}),
            "bench missing": ("zarr.json:attributes.bench", None),
        },
    ),
    "marker archive": (
        f"train force {{}} --sensor dots --split {SPLIT} --preset tiny --out x",
        ARCHIVE,
        ".markers.zarr",
        {
            "newer version": ("zarr.json:attributes.format_version", 99),
            "column missing": ("dots/table/wrench", None),
            "markers missing": ("dots/markers", None),
            "cut short": ("dots/zarr.json", 40),
        },
    ),
    "stored plan": (
        "sim archive {} --no-check",
        PLANNED,
        ".markers.zarr",
        {
            "plan missing": (PLAN, None),
            "key unknown": (f"{PLAN}.wings", 2),
            "key missing": (f"{PLAN}.sensors", None),
            "text for a number": (f"{PLAN}.seed", "one"),
            "not a number": (f"{BODY}.modulus", float("nan")),
            "out of range": (f"{BODY}.poisson", 0.7),
            "kind misspelt": (f"{PLAN}.sensors.0.trajectory.kind", "pres_shear"),
        },
    ),
    "model": (
        f"predict {{}} {ARCHIVE} --sensor dots --split {SPLIT} --out x.npz",
        MODEL,
        "",
        {
            "settings missing": ("config.yaml", None),
            "settings cut short": ("config.yaml", 500),
            "weights missing": ("model.safetensors", None),
            "weights cut short": ("model.safetensors", 1000),
        },
    ),
    "calibration": (
        "collect --sensor gelsight --indenter cylinder --calibrations {} --out x.zarr",
        "",
        "",
        {
            "unit left out": ("gelsight.yaml", HOME.replace("_mm", "")),
            "keys missing": ("gelsight.yaml", HOME),
            "another sensor's": ("gelsight.yaml", HOME.replace("gelsight", "tacpalm")),
            "part misspelt": ("gelsight.yaml", HOME.replace("home", "hone")),
            "a number for a part": ("gelsight.yaml", "sensor: gelsight\nhome: {cylinder: 0.1}"),
            "cut short": ("gelsight.yaml", HOME[:-2]),
            "key twice": ("gelsight.yaml", "sensor: gelsight\nsensor: gelsight"),
            "empty": ("gelsight.yaml", ""),
        },
    ),
}


@dataclass(frozen=True)
class Refusal:
    """Outcome of a command that read a wrong file."""

    mistake: str
    code: int
    message: str
    """Standard error, without `wrong input:` and the paths of this machine."""
    written: tuple[str, ...]
    """Files that were there afterwards and not before."""


def intact_files(folder: Path) -> None:
    """Write the files that mistakes are made in: a session, archives, a split and a model."""
    import torch
    from support.force_models import TOY
    from support.learning_sessions import record
    from support.made_up_archives import made_up_archive
    from support.sessions import set_attrs

    from learning.data.splits import make_split
    from learning.force.model import KIND, ForceModel
    from learning.training.run import RunFolder
    from sim.dataset import DatasetPlan, Solving, begin
    from sim.sensors import sensor
    from trajectories import PressShear, plan_to_json

    record(folder / SESSION)
    press = PressShear(
        step_x=1e-3, step_y=1e-3, depth_step=1e-3, depth_max=1e-3, angle_step=math.pi, shear=1e-3
    )
    set_attrs(folder / SESSION, plan=plan_to_json(press), bench={"mock": True})
    archive = made_up_archive(folder / ARCHIVE, targets=3, frames_per_phase=1)
    make_split(archive, validation=0.2, new_press=0.2).write(folder / SPLIT)
    plan = DatasetPlan("targets", (sensor("r6"),), ("sphere",), solving=Solving(tier="layer"))
    begin(folder / PLANNED, plan)
    model = ForceModel(TOY.network, TOY.input)
    run = RunFolder.open(folder / MODEL, KIND, TOY, "data", metadata={"sensors": ["dots"]})
    run.finish(1, {"model": model})
    torch.manual_seed(0)


def refusals(kind: str, folder: Path) -> Iterator[Refusal]:
    """Make each mistake of a kind in a folder of intact files, and run the command on it."""
    command, *_, suffix, mistakes = TEXTS.get(kind) or FOLDERS[kind]
    for mistake, change in mistakes.items():
        name = mistake.replace(" ", "-").replace("'", "") + suffix
        if kind in FOLDERS:
            _make_wrong(folder / name, FOLDERS[kind][1], *change)
        elif suffix:
            (folder / name).write_text(f"{change}\n")
        before = {*folder.rglob("*")}
        code, text = run(
            folder, command.replace("{}", name if suffix or kind in FOLDERS else change)
        )
        written = tuple(str(path.relative_to(folder)) for path in {*folder.rglob("*")} - before)
        yield Refusal(mistake, code, text, written)


def run(folder: Path, command: str) -> tuple[int, str]:
    """Run `tactile COMMAND` in a folder; return the exit code and its error text."""
    from tactile.run import main

    errors = io.StringIO()
    with chdir(folder), redirect_stderr(errors), redirect_stdout(io.StringIO()):
        code = main(shlex.split(command))
    text = errors.getvalue().replace(f"{ROOT}/", "").replace(f"{folder}/", "")
    return code, " ".join(text.split()).removeprefix("wrong input: ")


def _make_wrong(folder: Path, source: str, place: str, value: object) -> None:
    name, _, keys = place.partition(":")
    path = folder / name
    if not source:
        folder.mkdir()
        path.write_text(f"{value}\n")
        return
    shutil.copytree(folder.parent / source, folder)
    if source == SESSION:
        # As in its first run, when no manifest says that a file was changed.
        shutil.rmtree(folder / "manifest")
        _set(folder / "zarr.json", "attributes.status", "recording")
    if keys:
        _set(path, keys, value)
    elif isinstance(value, int):
        path.write_bytes(path.read_bytes()[:value])
    elif path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _set(path: Path, keys: str, value: object) -> None:
    """Change a value of a JSON file, or remove it if it is to be None."""
    inner = document = json.loads(path.read_text())
    *parents, last = keys.split(".")
    for key in parents:
        inner = inner[int(key) if isinstance(inner, list) else key]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    path.write_text(json.dumps(document))
