"""Mistakes in files, one or more in each kind of file, and the command that reads it.

`docs/reference/wrong-inputs.md` is made of these cases and their records by `make reference`.
"""

from __future__ import annotations

from golden import Case

SPLIT, ARCHIVE, MODEL = "{data}/split.json", "{data}/skins.markers.zarr", "{data}/models/force"
SESSION = "{data}/gelsight.zarr"
BENCH = "extends: {root}/rig/bench/benches/gelsight.yaml"
SENSOR = "extends: {root}/sim/sensors/rows/gelsight.yaml"
MARKERS = "extends: {root}/learning/markers/presets/bench-gelsight.yaml"
FORCE = "extends: {root}/learning/force/presets/tiny.yaml"
DEMO = "extends: {root}/learning/experiment/presets/demo.yaml"
ENTRY = "sessions: [{sensor: uskin, indenter: cone%s}]"
WRONG_SPLIT = (
    '{"format": "tactile-rig split", "format_version": 1, "seed": 0, "validation": 0.2, '
    '"new_press": 0.2, "held_out_sensors": [], "presses": {"train": {"cone": [[0, %s]]}}}'
)
X = "--out {out}/x"

# Mistakes by kind of file: the command, with {} for the file, its suffix, and texts.
TEXTS: dict[str, tuple[str, str, dict[str, str]]] = {
    "bench": (
        "tactile collect --bench {} --out {out}/x.zarr",
        ".yaml",
        {
            "key misspelt": f"{BENCH}\nlimits: {{depth_max_m: 1.3}}",
            "unit left out": f"{BENCH}\nlimits: {{depth_max: 1.3}}",
            "metres for millimetres": f"{BENCH}\ntrajectory: {{depth_max_mm: 0.0012}}",
            "ten times as deep": f"{BENCH}\ntrajectory: {{depth_max_mm: 12.0}}",
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
        "tactile campaign --file {} --list",
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
        "tactile sim archive {} --tier layer --scale smoke --out {out}/x.markers.zarr",
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
        f"tactile markers {SESSION} --preset {{}} --out {{out}}/x.markers.zarr",
        ".yaml",
        {
            "unit left out": f"{MARKERS}\narea: [40, 6000]",
            "metres for millimetres": f"{MARKERS}\nmm_per_px: 0.0000249",
            "kind misspelt": f"{MARKERS}\ndetectors: [{{kind: contrst, window_px: 49}}]",
            "range reversed": f"{MARKERS}\narea_px: [6000, 40]",
            "text for a number": f"{MARKERS}\nsmooth_px: three",
            "a sensor": SENSOR,
            "for taxels": "extends: {root}/learning/markers/presets/uskin.yaml",
        },
    ),
    "training preset": (
        f"tactile train force {ARCHIVE} --sensor r6 --split {SPLIT} --preset {{}} {X}",
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
        f"tactile experiment {ARCHIVE} --preset {{}} {X}",
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
        f"tactile predict {MODEL} {ARCHIVE} --sensor r6 --split {{}} --out {{out}}/x.npz",
        ".json",
        {
            "cut short": (WRONG_SPLIT % 5)[:150],
            "newer version": (WRONG_SPLIT % 5).replace('version": 1', 'version": 9'),
            "part missing": (WRONG_SPLIT % 5).replace('"presses"', '"pressed"'),
            "text for a number": WRONG_SPLIT % '"a"',
            "a bench": BENCH,
        },
    ),
    "settings": (
        f"tactile train force {ARCHIVE} --sensor r6 --split {SPLIT} --preset tiny {X} --set {{}}",
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
# Mistakes in copied folders: the command, the folder, its name, and changes (a value, or bytes that
# are left; None deletes), or the only file of a new folder.
FOLDERS: dict[str, tuple[str, str, str, dict[str, tuple[str, object]]]] = {
    "session": (
        "tactile session info {} --picture {out}/x.png",
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
        "tactile collect --resume {}",
        SESSION,
        ".zarr",
        {
            "plan missing": ("zarr.json:attributes.plan", None),
            "plan misspelt": ("zarr.json:attributes.plan", {"kind": "pres"}),
            "bench missing": ("zarr.json:attributes.bench", None),
        },
    ),
    "marker archive": (
        f"tactile train force {{}} --sensor r6 --split {SPLIT} --preset tiny {X}",
        ARCHIVE,
        ".markers.zarr",
        {
            "newer version": ("zarr.json:attributes.format_version", 99),
            "column missing": ("r6/table/wrench", None),
            "markers missing": ("r6/markers", None),
            "cut short": ("r6/zarr.json", 40),
        },
    ),
    "stored plan": (
        "tactile sim archive {} --no-check",
        ARCHIVE,
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
        f"tactile predict {{}} {ARCHIVE} --sensor r6 --split {SPLIT} --out {{out}}/x.npz",
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
        "tactile collect --sensor gelsight --indenter cylinder --calibrations {} "
        "--out {out}/x.zarr",
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


def _place(mistake: str, suffix: str) -> str:
    return "{out}/" + mistake.replace(" ", "-").replace("'", "") + suffix


def _change(folder: str, source: str, place: str, value: object) -> tuple[object, ...]:
    name, _, keys = place.partition(":")
    if not source:
        return ("write", f"{folder}/{name}", f"{value}\n")
    if keys:
        return ("json", f"{folder}/{name}", keys, value)
    return ("delete", f"{folder}/{name}") if value is None else ("cut", f"{folder}/{name}", value)


def _of_texts(kind: str) -> Case:
    command, suffix, mistakes = TEXTS[kind]
    given = {each: _place(each, suffix) if suffix else text for each, text in mistakes.items()}
    return Case(
        f"wrong-{kind.replace(' ', '-')}",
        tuple(command.replace("{}", each) for each in given.values()),
        one_process=True,
        once=True,
        prepare=tuple(
            ("write", given[each], f"{text}\n") for each, text in mistakes.items() if suffix
        ),
    )


def _of_folders(kind: str) -> Case:
    command, source, suffix, mistakes = FOLDERS[kind]
    steps: list[tuple[object, ...]] = []
    for mistake, change in mistakes.items():
        folder = _place(mistake, suffix)
        steps += [("copy", source, folder)] if source else []
        if source == SESSION:
            # As in its first run, when no manifest says that a file was changed.
            steps.append(("delete", f"{folder}/manifest"))
            steps.append(("json", f"{folder}/zarr.json", "attributes.status", "recording"))
        steps.append(_change(folder, source, *change))
    return Case(
        f"wrong-{kind.replace(' ', '-')}",
        tuple(command.replace("{}", _place(mistake, suffix)) for mistake in mistakes),
        one_process=True,
        once=True,
        prepare=tuple(steps),
    )


# Mistakes of each case, in the order of its commands.
MISTAKES = {kind: tuple(entry[-1]) for kind, entry in (TEXTS | FOLDERS).items()}
WRONG_FILES = {kind: _of_texts(kind) for kind in TEXTS} | {
    kind: _of_folders(kind) for kind in FOLDERS
}
