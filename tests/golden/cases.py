"""The cases of the golden set: command lines of all packages, and the outputs that are compared."""

# ruff: noqa: E501  (a command line is one line)

from __future__ import annotations

from golden import Case
from wrong_files import WRONG_FILES

GELSIGHT, USKIN = "{data}/gelsight.zarr", "{data}/uskin.zarr"
ARCHIVE, SPLIT = "{data}/skins.markers.zarr", "{data}/split.json"
MODELS = "{data}/models"


def _bench(text: str, of: str = "gelsight") -> str:
    """Return a bench file that modifies a packaged one."""
    return f"extends: {{root}}/rig/bench/benches/{of}.yaml\n{text}\n"


def _copied(source: str, name: str = "x.zarr", *steps: tuple[object, ...]) -> tuple[object, ...]:
    """Return the steps that copy a session or archive and then modify it."""
    inside = tuple((kind, f"{{out}}/{name}/{path}", *rest) for kind, path, *rest in steps)
    return (("copy", source, f"{{out}}/{name}"), *inside)


# As in the first run of a session, when no manifest says that a file was changed.
OPEN = (("delete", "manifest"), ("json", "zarr.json", "attributes.status", "recording"))


# Rig

WRONG_BENCHES = {
    "unknown-key": "wheels: 4",
    "unknown-inner-key": "arm: {wheels: 4}",
    "wrong-type": "rate_hz: fast",
    "not-finite": "rate_hz: .nan",
    "too-deep": "trajectory: {depth_max_mm: 3.0}",
    "unknown-kind": "camera: {kind: eye, address: x, rate_hz: 30.0}",
    "no-unit": "limits: {depth_max: 1.0}",
    "twice": "rate_hz: 40.0\nrate_hz: 50.0",
    "outside-box": "trajectory: {step_x_mm: 9.0}",
}
WRONG_CAMPAIGNS = {
    "none": "sessions: []",
    "key": "session: []",
    "indenter": "sessions: [{sensor: gelsight}]",
    "sensor": "sessions: [{sensor: nosuch, indenter: cone}]",
    "plan": "sessions: [{sensor: gelsight, indenter: cone, plan: wave}]",
    "targets": "sessions: [{sensor: gelsight, indenter: cone, targets: 999}]",
    "plan-twice": "sessions: [{sensor: uskin, indenter: cone, plan: a, plan: b}]",
}
RIG_CASES = (
    Case(
        "rig-bench-refused",
        timed=False,
        commands=(
            *(
                f"tactile collect --bench {{out}}/{name}.yaml --out {{out}}/x.zarr"
                for name in WRONG_BENCHES
            ),
            "tactile collect --bench {out}/none.yaml --out {out}/x.zarr",
            "tactile collect --bench {out}/list.yaml --out {out}/x.zarr",
            "tactile collect --sensor nosuch --out {out}/x.zarr",
            "tactile collect --out {out}/x.zarr",
        ),
        one_process=True,
        prepare=(
            *(
                ("write", f"{{out}}/{name}.yaml", _bench(text))
                for name, text in WRONG_BENCHES.items()
            ),
            ("write", "{out}/list.yaml", "[1, 2]\n"),
        ),
    ),
    Case(
        "rig-collect-refused",
        (
            "tactile collect --sensor nosuch --out {out}/a.zarr",
            "tactile collect --sensor gelsight --targets 0 --out {out}/a.zarr",
            "tactile collect --sensor gelsight --targets 999 --out {out}/a.zarr",
            "tactile collect --sensor gelsight --bench a.yaml --out {out}/a.zarr",
            "tactile collect --sensor gelsight --camera {out}/nowhere --out {out}/a.zarr",
            "tactile collect --sensor gelsight --taxels {out}/none.npy --out {out}/a.zarr",
            "tactile collect --resume {out}/nowhere.zarr",
            "tactile collect --resume {out}/x.zarr --targets 3",
            "tactile collect --resume {out}/x.zarr --sensor tacpalm",
            "tactile home --sensor gelsight --repeats 0 --out {out}/a.zarr",
            "tactile calibrate-latency --sensor gelsight --taps 0 --out {out}/a.zarr",
            "tactile jog --sensor gelsight",
            "tactile grip --sensor nosuch",
        ),
        one_process=True,
        prepare=_copied(GELSIGHT),
    ),
    Case(
        "rig-out-exists",
        (
            "tactile collect --sensor gelsight --targets 1 --out {out}/x.zarr",
            "tactile force-depth --sensor gelsight --out {out}/x.zarr",
        ),
        prepare=_copied(GELSIGHT),
        loose=True,
        slow=True,
    ),
    Case(
        "rig-resume-refused",
        (
            "tactile collect --resume {out}/y.zarr --bench {out}/same.yaml",
            "tactile collect --resume {out}/z.zarr",
        ),
        one_process=True,
        prepare=(
            ("write", "{out}/same.yaml", _bench("", of="tacpalm")),
            *_copied(GELSIGHT, "y.zarr", *OPEN),
            *_copied(GELSIGHT, "z.zarr", ("json", "zarr.json", "attributes.format_version", 99)),
        ),
    ),
    Case(
        "rig-campaign",
        (
            "tactile campaign --file campaigns/day.yaml --out {out}/none --list",
            "tactile campaign --file {out}/none.yaml --list",
            *(f"tactile campaign --file {{out}}/{name}.yaml --list" for name in WRONG_CAMPAIGNS),
        ),
        one_process=True,
        prepare=tuple(
            ("write", f"{{out}}/{name}.yaml", f"out: {{out}}/day\n{text}\n")
            for name, text in WRONG_CAMPAIGNS.items()
        ),
    ),
    Case(
        "rig-replay",
        (f"tactile replay --session {GELSIGHT} --speed max --out {{out}}/x.zarr",),
        look=("x.zarr",),
        loose=True,
    ),
    Case(
        "rig-replay-taxels",
        (f"tactile replay --session {USKIN} --speed max --out {{out}}/x.zarr",),
        look=("x.zarr",),
        loose=True,
    ),
    Case(
        "rig-replay-refused",
        (
            "tactile replay --session {out}/none.zarr --out {out}/x.zarr",
            f"tactile replay --session {GELSIGHT} --speed 0 --out {{out}}/x.zarr",
            f"tactile replay --session {GELSIGHT} --speed x --out {{out}}/x.zarr",
            f"tactile replay --session {GELSIGHT} --out {GELSIGHT}",
            f"tactile replay --session {GELSIGHT} --without smell --out {{out}}/x.zarr",
            f"tactile replay --session {ARCHIVE} --out {{out}}/x.zarr",
        ),
        one_process=True,
    ),
    Case(
        "rig-collect-tacpalm",
        (
            "tactile collect --sensor tacpalm --targets 1 --indenter cylinder --operator golden "
            "--calibrations {out}/none --out {out}/x.zarr --truth {out}/x.truth",
            "tactile session check {out}/x.zarr",
        ),
        look=("*",),
        loose=True,
        unstable=(r"commands\.[12]\.(exit|text.*)", r"files\..*\.log.*"),
    ),
    Case(
        "rig-collect-uskin",
        (
            "tactile collect --sensor uskin --targets 2 --indenter cylinder --operator golden "
            "--calibrations {out}/none --out {out}/x.zarr",
            "tactile session info {out}/x.zarr",
        ),
        look=("x.zarr",),
        loose=True,
    ),
    Case(
        "rig-force-depth",
        (
            "tactile force-depth --bench {out}/b.yaml --operator golden --calibrations {out}/none "
            "--out {out}/x.zarr",
        ),
        prepare=(
            (
                "write",
                "{out}/b.yaml",
                _bench("force_depth: {kind: force_depth, depth_max_mm: 0.4, repeats: 1}", "uskin"),
            ),
        ),
        look=("x.zarr",),
        loose=True,
        slow=True,
    ),
    Case(
        "rig-world-sim",
        (
            "tactile collect --sensor uskin --world sim --targets 1 --indenter cylinder --operator golden "
            "--calibrations {out}/none --out {out}/x.zarr",
        ),
        look=("x.zarr",),
        loose=True,
        slow=True,
    ),
    Case(
        "rig-live",
        (
            f"tactile live --model {MODELS}/force --session {GELSIGHT} --runtime torch --seconds 2 "
            "--out {out}/x.csv",
        ),
        look=("x.csv",),
        loose=True,
        unstable=(r"commands\.0\.text.*",),
    ),
    Case(
        "rig-live-refused",
        (
            f"tactile live --model {{out}}/none --session {GELSIGHT}",
            f"tactile live --model {MODELS}/field --session {GELSIGHT} --runtime torch",
            f"tactile live --model {MODELS}/force --session {GELSIGHT} --runtime onnx",
            f"tactile live --model {MODELS}/force --session {GELSIGHT} --sensor gelsight",
            f"tactile live --model {MODELS}/force --session {GELSIGHT} --seconds 0",
            f"tactile live --model {MODELS}/force --session {{out}}/none.zarr",
            f"tactile live --session {GELSIGHT}",
        ),
        one_process=True,
    ),
)

# Recorder

NEWER = ("json", "zarr.json", "attributes.format_version", 99)
RECORDER_CASES = (
    Case(
        "recorder-info",
        (
            f"tactile session info {GELSIGHT}",
            f"tactile session info {USKIN}",
            f"tactile session info {ARCHIVE}",
        ),
        one_process=True,
        portable=True,
    ),
    Case(
        "recorder-check",
        (
            f"tactile session check {GELSIGHT}",
            f"tactile session check {USKIN}",
            f"tactile session check {ARCHIVE}",
        ),
        one_process=True,
        portable=True,
    ),
    Case(
        "recorder-check-broken",
        tuple(f"tactile session check {{out}}/{name}.zarr" for name in "abcdefgh"),
        one_process=True,
        portable=True,
        prepare=(
            *_copied(GELSIGHT, "a.zarr", ("delete", "streams/force/seq/c/0")),
            *_copied(GELSIGHT, "b.zarr", ("json", "zarr.json", "attributes.status", "recording")),
            *_copied(GELSIGHT, "c.zarr", ("cut", "streams/force/value/c/0/0", 2000)),
            *_copied(GELSIGHT, "d.zarr", ("delete", "streams/force/zarr.json")),
            *_copied(USKIN, "e.zarr", ("delete", "streams/taxels/value")),
            *_copied(USKIN, "f.zarr", ("json", "streams/force/value/zarr.json", "attributes", {})),
            *_copied(ARCHIVE, "g.zarr", ("delete", "r6/table/wrench")),
            *_copied(ARCHIVE, "h.zarr", ("delete", "r18/zarr.json")),
        ),
    ),
    Case(
        "recorder-refused",
        (
            *(
                f"tactile session {command} {{out}}/none.zarr"
                for command in ("info", "check", "recover")
            ),
            *(f"tactile session {command} {{out}}/text.zarr" for command in ("info", "check")),
            *(
                f"tactile session {command} {{out}}/newer.zarr"
                for command in ("info", "check", "recover")
            ),
            "tactile session info {out}/other.zarr",
            "tactile session info {out}/bare.zarr",
            "tactile session info {out}/newer.markers.zarr",
            "tactile session info {out}/broken.zarr",
            f"tactile session info {ARCHIVE} --picture {{out}}/x.png",
            f"tactile session export {GELSIGHT} {{out}}/newer.zarr --to zarr",
            f"tactile session export {GELSIGHT} {{out}}/x.zarr --to zarr --images smaller",
            f"tactile session export {GELSIGHT} {{out}}/newer.zarr --to hdf5",
            f"tactile session export {GELSIGHT} {{out}}/x --to word",
            f"tactile session export {ARCHIVE} {{out}}/x --to hdf5",
            "tactile session recover s3://bucket/x.zarr",
        ),
        one_process=True,
        portable=True,
        prepare=(
            ("write", "{out}/text.zarr", "no session\n"),
            *_copied(GELSIGHT, "newer.zarr", NEWER),
            *_copied(GELSIGHT, "other.zarr", ("json", "zarr.json", "attributes.format", "else")),
            *_copied(GELSIGHT, "bare.zarr", ("json", "zarr.json", "attributes", {})),
            *_copied(ARCHIVE, "newer.markers.zarr", NEWER),
            *_copied(GELSIGHT, "broken.zarr", ("cut", "zarr.json", 300)),
        ),
    ),
    Case(
        "recorder-missing-field",
        tuple(f"tactile session info {{out}}/{name}.zarr" for name in "abcdef"),
        one_process=True,
        portable=True,
        prepare=(
            *_copied(GELSIGHT, "a.zarr", *OPEN, ("json", "zarr.json", "attributes.status", None)),
            *_copied(GELSIGHT, "b.zarr", *OPEN, ("json", "zarr.json", "attributes.sensor", None)),
            *_copied(GELSIGHT, "c.zarr", *OPEN, ("json", "zarr.json", "attributes.t0_ns", None)),
            *_copied(GELSIGHT, "d.zarr", *OPEN, ("delete", "segments")),
            *_copied(GELSIGHT, "e.zarr", *OPEN, ("delete", "streams/camera")),
            *_copied(GELSIGHT, "f.zarr", *OPEN, ("delete", "frames")),
        ),
    ),
    Case(
        "recorder-recover",
        (
            "tactile session recover {out}/x.zarr",
            "tactile session recover {out}/x.zarr",
            "tactile session check {out}/x.zarr",
        ),
        one_process=True,
        portable=True,
        prepare=_copied(
            GELSIGHT,
            "x.zarr",
            *OPEN,
            ("write", "streams/force/t_ns/journal-99999", "torn"),
        ),
        look=("x.zarr",),
    ),
    Case(
        "recorder-export-zarr-pixels",
        (
            f"tactile session export {GELSIGHT} {{out}}/x.zarr --to zarr --images pixels",
            "tactile session info {out}/x.zarr",
        ),
        portable=True,
        look=("x.zarr",),
    ),
    Case(
        "recorder-export-zarr",
        (f"tactile session export {GELSIGHT} {{out}}/x.zarr --to zarr",),
        portable=True,
        look=("x.zarr",),
    ),
    Case(
        "recorder-export-hdf5",
        (
            f"tactile session export {USKIN} {{out}}/x.h5 --to hdf5",
            f"tactile session export {GELSIGHT} {{out}}/y.h5 --to hdf5",
            f"tactile session export {GELSIGHT} {{out}}/z.h5 --to hdf5 --images pixels",
        ),
        one_process=True,
        portable=True,
        look=("*.h5",),
    ),
    Case(
        "recorder-export-mcap",
        (
            f"tactile session export {USKIN} {{out}}/x.mcap --to mcap",
            f"tactile session export {GELSIGHT} {{out}}/y.mcap --to mcap",
        ),
        one_process=True,
        portable=True,
        look=("*.mcap",),
    ),
    Case(
        "recorder-export-lerobot",
        (
            f"tactile session export {USKIN} {{out}}/x --to lerobot",
            f"tactile session export {GELSIGHT} {{out}}/y --to lerobot --valid-only",
        ),
        one_process=True,
        portable=True,
        look=("x", "y"),
    ),
    Case(
        "recorder-export-genforce",
        (
            f"tactile session export {GELSIGHT} {{out}}/x --to genforce",
            f"tactile session export {USKIN} {{out}}/y --to genforce",
        ),
        one_process=True,
        portable=True,
        look=("x", "y"),
    ),
    Case(
        "recorder-picture",
        (
            f"tactile session info {GELSIGHT} --picture {{out}}/x.png",
            f"tactile session info {USKIN} --picture {{out}}/y.png",
        ),
        one_process=True,
        look=("*.png",),
    ),
    Case(
        "tactile-import",
        (
            "tactile import {out}/a.zarr --video {out}/frames --fps 20 --sensor gelsight "
            "--indenter ball --operator golden --press none --yes",
            "tactile import {out}/b.zarr --taxels {out}/t.npy --taxels-hz 60 --taxel-order taxel "
            "--sensor uskin --indenter ball --operator golden --press none --yes",
            "tactile import {out}/c.zarr --video {out}/frames --fps 20 --force {out}/f.csv "
            "--force-hz 40 --units N --torque-units N*m --trim --sensor gelsight --indenter ball "
            "--operator golden --press none --lag 0 --yes",
            "tactile session info {out}/b.zarr",
            "tactile session check {out}/a.zarr",
        ),
        one_process=True,
        portable=True,
        prepare=(
            *(("png", f"{{out}}/frames/{index:03}.png", index) for index in range(12)),
            ("npy", "{out}/t.npy", 60, 48, 3),
            (
                "write",
                "{out}/f.csv",
                "fx,fy,fz,tx,ty,tz\n" + "".join(f"0,{n / 10},-{n},0,0,0.01\n" for n in range(24)),
            ),
        ),
        look=("*.zarr",),
    ),
    Case(
        "tactile-import-refused",
        (
            "tactile import {out}/a.zarr --sensor uskin --indenter ball",
            "tactile import {out}/a.zarr --taxels {out}/t.npy --sensor uskin --indenter ball",
            "tactile import {out}/a.zarr --taxels {out}/bad.npy --taxels-hz 60 --sensor u --indenter b",
            "tactile import {out}/a.zarr --taxels {out}/none.npy --taxels-hz 60 --sensor u --indenter b",
            "tactile import {out}/a.zarr --taxels {out}/t.npy --taxels-hz -1 --sensor u --indenter b",
            "tactile import {out}/a.zarr --taxels {out}/n.npy --taxels-hz 60 --sensor u --indenter b",
            "tactile import {out}/a.zarr --force {out}/f.csv --force-hz 40 --sensor u --indenter b",
            "tactile import {out}/a.zarr --video {out}/f.csv --fps 9 --sensor u --indenter b",
            "tactile import {out}/a.zarr --video {out}/none --fps 9 --sensor u --indenter b",
        ),
        one_process=True,
        portable=True,
        prepare=(
            ("npy", "{out}/t.npy", 60, 48, 3),
            ("npy", "{out}/n.npy", 60, 7, 3),
            ("write", "{out}/bad.npy", "no array"),
            ("write", "{out}/f.csv", "fx,fy,fz\n1,2,x\n"),
        ),
    ),
)

# Simulator: forces, surface and quality of scenes over tiers, effects and precisions


def _scene(name: str, words: str, **more: object) -> Case:
    line = f"tactile sim {words} --json --save {{out}}/x.zarr"
    return Case(f"sim-{name}", (line,), look=("x.zarr",), timeout=600, **more)  # type: ignore[arg-type]


STL = "solid wedge\n" + "".join(
    "facet normal 0 0 0\nouter loop\n"
    + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners)
    + "endloop\nendfacet\n"
    for corners in (
        ((-2, -2, 3), (2, -2, 3), (2, 2, 3)),
        ((-2, -2, 3), (2, 2, 3), (-2, 2, 3)),
        ((0, 0, 0), (2, -2, 3), (-2, -2, 3)),
        ((0, 0, 0), (2, 2, 3), (2, -2, 3)),
        ((0, 0, 0), (-2, 2, 3), (2, 2, 3)),
        ((0, 0, 0), (-2, -2, 3), (-2, 2, 3)),
    )
)
SIM_CASES = (
    _scene("layer-press-sphere", "press --tier layer --shape sphere:radius=4 --depths 0.5,1"),
    _scene("layer-press-dots", "press --tier layer --shape dots --depths 0.3,0.6 --at -2,1.5"),
    _scene(
        "layer-loop-prism",
        "press --tier layer --shape prism --depths 0.8 --shear 0.6 --steps 2 --friction 0.5",
    ),
    _scene(
        "layer-hold",
        "press --tier layer --shape cylinder --depths 0.6 --hold 2 --steps 3 --viscosity 0.5:0.5",
    ),
    _scene(
        "layer-viscous-friction",
        "press --tier layer --shape moon --depths 0.5 --shear 0.4 --angle 30 --steps 2 "
        "--viscosity 0.5:0.5,0.2:0.05 --friction 0.8",
    ),
    _scene("fem-press-sphere", "press --shape sphere:radius=4 --depths 0.4,0.8 --tier fem:0.4"),
    _scene(
        "fem-press-box",
        "press --shape box:width=4,length=3 --depths 0.3,0.6 --tier fem:0.4",
    ),
    _scene(
        "fem-press-prism",
        "press --shape prism --depths 0.3,0.6 --tier fem:0.4 --size 16,16,4",
    ),
    _scene(
        "fem-loop-friction",
        "press --shape cylinder --depths 0.6 --shear 0.5 --steps 2 --tier fem:0.4 --friction 0.5",
    ),
    _scene(
        "fem-hold-viscosity",
        "press --shape sphere:radius=3 --depths 0.6 --hold 2 --steps 2 --tier fem:0.4 --viscosity 0.5:0.5",
    ),
    _scene(
        "fem-viscosity-shear",
        "press --shape moon --depths 0.4 --hold 2 --steps 2 --tier fem:0.4 --relaxes shear --viscosity 0.5:0.1",
    ),
    _scene("fem-gravity", "press --shape dots --depths 0.3,0.5 --tier fem:0.4 --gravity 0,-9.81,0"),
    _scene(
        "fem-inertia",
        "press --shape sphere:radius=4 --depths 0.2,0.4 --tier fem:0.4 --inertia --speed 50",
    ),
    _scene("fem-dome", "press --shape plane --depths 0.3,0.6 --dome 60 --tier fem:0.4"),
    _scene(
        "fem-all-effects",
        "press --shape sphere:radius=4 --depths 0.5 --shear 0.3 --steps 2 --tier fem:0.4 --friction 0.6 "
        "--viscosity 0.4:0.2 --gravity --inertia 1",
        slow=True,
    ),
    Case(
        "sim-fem-stl-tilted",
        (
            "tactile sim press --shape {out}/wedge.stl --tilt 5,-3 --depths 0.3,0.6 --tier fem:0.4 --json "
            "--save {out}/x.zarr",
            "tactile sim press --shape {out}/wedge.stl:unit=m --depths 0.3 --tier layer --json",
            "tactile sim press --shape {out}/text.stl --depths 0.3 --tier layer --json",
        ),
        prepare=(
            ("write", "{out}/wedge.stl", STL + "endsolid wedge\n"),
            ("write", "{out}/text.stl", "no body\n"),
        ),
        look=("x.zarr",),
        timeout=600,
    ),
    _scene("tilted-layer", "press --shape cylinder --tilt 4,2 --tier layer --depths 0.4,0.8"),
    _scene("tolerance", 'press --shape sphere:radius=4 --depths 0.5 --tolerance "20 %"'),
    Case(
        "sim-table-and-picture",
        (
            "tactile sim press --tier layer --shape dots --depths 0.2,0.4 --out {out}/press.png",
            "tactile sim press --tier layer --shape sphere --depths 1 --shear 1 --friction 0.5 --out {out}/loop.png",
            "tactile sim press --tier layer --shape line --depths 1 --hold 2 --steps 2 --viscosity 0.5:0.5 --out {out}/hold.png",
        ),
        one_process=True,
        look=("*.png",),
    ),
    Case(
        "sim-archive-sensors",
        (
            "tactile sim archive gelsight,tacpalm,uskin --tier layer --scale smoke --steps 1 "
            "--indenters sphere --processes 1 --out {out}/x.markers.zarr",
            "tactile session info {out}/x.markers.zarr",
        ),
        look=("x.markers.zarr",),
        timeout=600,
        slow=False,
    ),
    Case(
        "sim-archive-in-use",
        (
            "tactile sim archive array-i,{out}/mine.yaml --tier layer --scale 0.005 --steps 1 "
            "--indenters cone --processes 2 --no-check --seed 3 --out {out}/x.markers.zarr",
        ),
        prepare=(
            (
                "write",
                "{out}/mine.yaml",
                "extends: {root}/sim/sensors/rows/gelsight.yaml\ndescription: our own skin\n"
                "body: {modulus_kpa: 200.0}\nsignal: {patterns: [Circle-I]}\n"
                "variation: {mount: {shift_mm: 0.2, turn_deg: 1.0}}\n",
            ),
        ),
        look=("x.markers.zarr",),
        rtol_elsewhere=0.05,  # torques of light touches are only as accurate as the residual
        timeout=600,
        slow=True,
    ),
    Case(
        "sim-archive-states",
        (
            "tactile sim archive states:Array1,Circle1 --scale smoke --indenters sphere --tier layer "
            "--processes 1 --out {out}/x.markers.zarr",
            "tactile sim archive states:Array1,Circle1 --scale smoke --indenters sphere --tier layer "
            "--processes 1 --out {out}/x.markers.zarr",
            "tactile sim archive states:Array1 --scale smoke --indenters sphere --tier layer "
            "--processes 1 --out {out}/x.markers.zarr",
            "tactile sim archive {out}/x.markers.zarr --no-check",
        ),
        look=("x.markers.zarr",),
        timeout=600,
        slow=True,
    ),
    Case(
        "sim-archive-fem",
        (
            "tactile sim archive r6,r18 --tier fem --spacing 1.3 --scale smoke --steps 1 "
            "--indenters sphere --processes 1 --no-check --out {out}/x.markers.zarr",
        ),
        look=("x.markers.zarr",),
        timeout=900,
        slow=True,
    ),
    Case(
        "sim-archive-refused",
        (
            "tactile sim archive digit --out {out}/x.markers.zarr",
            "tactile sim archive {out}/key.yaml --out {out}/x.markers.zarr",
            "tactile sim archive {out}/value.yaml --out {out}/x.markers.zarr",
            "tactile sim archive {out}/none.yaml --out {out}/x.markers.zarr",
            "tactile sim archive {out}/list.yaml --out {out}/x.markers.zarr",
            "tactile sim archive {out}/circle.yaml --out {out}/x.markers.zarr",
            "tactile sim archive homogeneous --scale 2 --out {out}/x.markers.zarr",
            "tactile sim archive homogeneous --indenters egg --out {out}/x.markers.zarr",
            "tactile sim archive homogeneous --steps -1 --out {out}/x.markers.zarr",
            'tactile sim archive material --tier fem --tolerance "3 %" --out {out}/x.markers.zarr',
            "tactile sim archive states:Spiral --out {out}/x.markers.zarr",
            "tactile sim archive states --processes 0 --tier layer --scale smoke --out {out}/x.markers.zarr",
            "tactile sim archive {out}/none.markers.zarr",
            f"tactile sim archive {ARCHIVE.replace('skins.markers', 'gelsight')}",
        ),
        one_process=True,
        prepare=(
            (
                "write",
                "{out}/key.yaml",
                "extends: {root}/sim/sensors/rows/gelsight.yaml\nwings: 2\n",
            ),
            (
                "write",
                "{out}/value.yaml",
                "extends: {root}/sim/sensors/rows/gelsight.yaml\nbody: {modulus_kpa: soft}\n",
            ),
            ("write", "{out}/list.yaml", "[1]\n"),
            ("write", "{out}/circle.yaml", "extends: circle.yaml\n"),
        ),
    ),
    Case(
        "sim-mpm",
        ("benchmarks mpm --only 'cell 0.5 mm' --file {out}/rows.json",),
        look=("rows.json",),
        timeout=900,
        slow=True,
    ),
)

# Learning

FORCE = (
    f"--split {SPLIT} --preset tiny --set 'stages=[{{epochs: 2, learning_rate: 0.002}}]' "
    "--set input.side_px=32 --set 'network.encoder=[4, 4, 8]' --set network.memory=8 "
    "--set 'network.tail=[8, 8]'"
)
FEW = "--set 'launch={device: cpu, mixed_precision: no}' --set steps=2 --set batch=2"
WEIGHTS = ("x/model.safetensors", "x/config.yaml")


def _trained(name: str, line: str, **more: object) -> Case:
    return Case(
        f"learning-{name}",
        (f"{line} --out {{out}}/x",),
        look=("x/model.safetensors", "x/metrics.jsonl"),
        rtol_elsewhere=0.05,
        **more,  # type: ignore[arg-type]
    )


def _based(kind: str) -> tuple[tuple[object, ...], ...]:
    """Return the steps that copy a model and fill in the paths of its base networks."""
    return (
        ("copy", f"{MODELS}/{kind}", f"{{out}}/{kind}"),
        ("fill", f"{{out}}/{kind}/config.yaml"),
    )


TRANSLATED = "--source r6 --target r18 --out {out}/x.markers.zarr"
EXPERIMENT = (
    "--pairs r6:r18 --processes 1 --set scored_presses=0 --set 'fine_tuning=[]' "
    '--set \'force={preset: tiny, set: ["input.side_px=32", "network.encoder=[4, 4, 4]", '
    '"network.memory=4", "network.tail=[4, 4]", '
    '"stages=[{epochs: 1, learning_rate: 0.001}]"]}\' --set validation=0.0 --set new_press=0.2'
)
LEARNING_CASES = (
    Case(
        "learning-markers",
        (
            f"tactile markers {GELSIGHT} --out {{out}}/a.markers.zarr --preset bench-gelsight "
            "--sheet {out}/a.png",
            f"tactile markers {USKIN} --out {{out}}/b.markers.zarr",
            "tactile session info {out}/a.markers.zarr",
        ),
        one_process=True,
        look=("*.markers.zarr", "a.png"),
    ),
    Case(
        "learning-markers-refused",
        (
            f"tactile markers {GELSIGHT}",
            "tactile markers {out}/none.zarr --out {out}/a.markers.zarr",
            f"tactile markers {GELSIGHT} --out {{out}}/a.markers.zarr --preset nosuch",
            f"tactile markers {GELSIGHT} --out {{out}}/a.markers.zarr --preset {{out}}/key.yaml",
            f"tactile markers {GELSIGHT} {USKIN} --out {{out}}/a.markers.zarr",
            f"tactile markers {GELSIGHT} --out {{out}}/a.markers.zarr --mm-per-px -1",
            f"tactile markers {GELSIGHT} --out {{out}}/a.markers.zarr --sam-encoder x.onnx",
            f"tactile markers {ARCHIVE} --out {{out}}/a.markers.zarr",
        ),
        one_process=True,
        prepare=(("write", "{out}/key.yaml", "description: mine\nspeed: 3\n"),),
    ),
    Case(
        "learning-genforce",
        (
            f"tactile session export {ARCHIVE} {{out}}/x --to genforce",
            "tactile import {out}/x --out {out}/y.markers.zarr",
            "tactile session info {out}/y.markers.zarr",
            f"tactile session export {ARCHIVE} {{out}}/x --to genforce",
            "tactile import {out}/none --out {out}/z.markers.zarr",
            "tactile import {data} --out {out}/z.markers.zarr",
            "tactile import {out}/x --mm-per-px r6 --out {out}/z.markers.zarr",
        ),
        one_process=True,
        look=("x", "y.markers.zarr"),
    ),
    Case(
        "learning-compensate",
        (
            f"tactile compensate {ARCHIVE} --out {{out}}/a.json --split {SPLIT} --pairs r6:r18,r18:r6",
            f"tactile compensate {ARCHIVE} --out {{out}}/b.json --pairs r6:r18 --range-mm r6=0.4",
            f"tactile compensate {ARCHIVE} --out {{out}}/c.json --pairs r6:digit",
            f"tactile compensate {ARCHIVE} --out {{out}}/c.json --range-mm r6",
        ),
        one_process=True,
        look=("*.json", "*.png"),
    ),
    Case(
        "learning-translate-flow",
        (
            f"tactile translate {ARCHIVE} {TRANSLATED} --split {SPLIT} --role train --sheet {{out}}/x.png",
            "tactile session check {out}/x.markers.zarr",
        ),
        look=("x.markers.zarr",),
    ),
    Case(
        "learning-translate-field",
        (f"tactile translate {ARCHIVE} {TRANSLATED} --model {MODELS}/field",),
        look=("x.markers.zarr",),
        timeout=300,
    ),
    Case(
        "learning-translate-diffusion",
        (f"tactile translate {ARCHIVE} {TRANSLATED} --model {{out}}/diffusion",),
        prepare=_based("diffusion"),
        look=("x.markers.zarr",),
        timeout=300,
    ),
    Case(
        "learning-translate-refused",
        (
            f"tactile translate {ARCHIVE} --out {{out}}/x.markers.zarr",
            f"tactile translate {ARCHIVE} --source r6 --target digit --out {{out}}/x.markers.zarr",
            f"tactile translate {ARCHIVE} --source r6 --target r6 --out {{out}}/x.markers.zarr",
            f"tactile translate {ARCHIVE} {TRANSLATED} --model {{out}}/none",
            f"tactile translate {ARCHIVE} {TRANSLATED} --model {MODELS}/force",
            f"tactile translate {ARCHIVE} {TRANSLATED} --model {{out}}/broken",
            f"tactile translate {ARCHIVE} {TRANSLATED} --role train",
            f"tactile translate {ARCHIVE} {TRANSLATED} --split {SPLIT} --role nobody",
            f"tactile translate {GELSIGHT} {TRANSLATED}",
        ),
        one_process=True,
        prepare=(
            ("copy", f"{MODELS}/field", "{out}/broken"),
            ("cut", "{out}/broken/model.safetensors", 1000),
        ),
    ),
    Case(
        "learning-predict-evaluate",
        (
            f"tactile predict {MODELS}/force {ARCHIVE} --sensor r6 --split {SPLIT} "
            "--role train,validation,new_indenter --out {out}/results/r6.npz",
            f"tactile predict {MODELS}/force {ARCHIVE} --sensor r18 --split {SPLIT} "
            "--role train,validation,new_indenter --out {out}/results/r18.npz",
            "tactile evaluate {out}/results --out {out}/report",
            f"tactile predict {MODELS}/force {ARCHIVE} --sensor digit --split {SPLIT} --out {{out}}/a.npz",
            f"tactile predict {MODELS}/field {ARCHIVE} --sensor r6 --split {SPLIT} --out {{out}}/a.npz",
            f"tactile predict {MODELS}/force {ARCHIVE} --sensor r6 --split {{out}}/none.json --out {{out}}/a.npz",
            "tactile evaluate {out}/none --out {out}/report2",
        ),
        one_process=True,
        prepare=(("write", "{out}/results/.keep", ""),),
        look=("results/*.npz", "report"),
    ),
    Case(
        "learning-evaluate-translated",
        (
            f"tactile translate {ARCHIVE} {TRANSLATED}",
            f"tactile evaluate {{out}}/results {ARCHIVE} {{out}}/x.markers.zarr "
            f"--split {SPLIT} --role train,new_indenter --out {{out}}/report",
            f"tactile evaluate {{out}}/results {ARCHIVE} {{out}}/x.markers.zarr "
            f"--split {SPLIT} --role train --features {{out}}/marker-vae --out {{out}}/report2",
        ),
        prepare=(("write", "{out}/results/.keep", ""), *_based("marker-vae")),
        look=("results/*.npz", "report", "report2"),
        slow=True,
    ),
    _trained("train-force", f"tactile train force {ARCHIVE} --sensor r6 {FORCE}"),
    Case(
        "learning-train-force-compensated",
        (
            f"tactile compensate {ARCHIVE} --out {{out}}/c.json --pairs r6:r18",
            f"tactile translate {ARCHIVE} {TRANSLATED}",
            f"tactile train force {{out}}/x.markers.zarr --sensor r6-to-r18 {FORCE} "
            f"--labels {{out}}/c.json --start-from {MODELS}/force --out {{out}}/x",
            f"tactile train force {{out}}/x.markers.zarr --sensor r6-to-r18 {FORCE} "
            f"--labels {{out}}/c.json --start-from {MODELS}/force --out {{out}}/x",
        ),
        look=("x/model.safetensors",),
        rtol_elsewhere=0.05,
        slow=True,
    ),
    _trained(
        "train-field",
        f"tactile train field {ARCHIVE} --split {SPLIT} --preset cpu_smoke --sensors r6,r18 "
        "--set field_stage.steps=2 --set map_stage.steps=2 --set field_stage.warm_up_steps=1 "
        "--set map_stage.warm_up_steps=1 --set validate_every_steps=2 --set validated=2 "
        "--set field_stage.batch=2 --set map_stage.batch=2 --set 'net.widths=[8, 8, 16, 16, 16]' "
        "--set 'map.widths=[8, 8, 8, 8]' --set map.numbers=4 --set examples.patterns=4",
    ),
    _trained(
        "train-diffusion",
        f"tactile train diffusion {ARCHIVE} --split {SPLIT} --sensors r6,r18 --base {{data}}/base "
        f"{FEW} --set unet_rank=2 --set losses.adversarial=0 "
        "--set losses.perceptual=0 --set accumulation=1 --set marker_vae.steps=2 "
        "--set marker_vae.batch=2 --set marker_vae.mixed_precision=no",
        slow=True,
    ),
    Case(
        "learning-train-refused",
        (
            f"tactile train force {ARCHIVE} --sensor digit {FORCE} --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 {FORCE} --set wings=2 --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 {FORCE} --set input.side_px=big --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 {FORCE} --set nonsense --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 --split {SPLIT} --preset huge --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 {FORCE} --start-from {MODELS}/field --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 {FORCE} --labels {SPLIT} --out {{out}}/x",
            f"tactile train force {ARCHIVE} --sensor r6 {FORCE} --out {{out}}/force",
            f"tactile train force {GELSIGHT} --sensor r6 {FORCE} --out {{out}}/x",
            f"tactile train field {ARCHIVE} --split {SPLIT} --preset cpu_smoke --sensors digit --out {{out}}/x",
            f"tactile train field {ARCHIVE} --split {{out}}/none.json --out {{out}}/x",
            f"tactile train diffusion {ARCHIVE} --split {SPLIT} --base {{out}}/none --out {{out}}/x",
            "tactile train diffusion",
            "tactile import {out}/none.pkl --base {data}/base --out {out}/x",
            f"tactile import {SPLIT} --base {{data}}/base --out {{out}}/x",
        ),
        one_process=True,
        prepare=(("copy", f"{MODELS}/force", "{out}/force"),),
    ),
    Case(
        "learning-experiment",
        (
            f"tactile experiment {ARCHIVE} --out {{out}}/x {EXPERIMENT}",
            f"tactile experiment {ARCHIVE} --out {{out}}/x {EXPERIMENT} --set new_press=0.3",
        ),
        look=("x/results", "x/report", "x/*.json", "x/*.csv"),
        rtol_elsewhere=0.05,
        timeout=600,
        slow=True,
    ),
    Case(
        "learning-experiment-refused",
        (
            f"tactile experiment {ARCHIVE} --out {{out}}/x --pairs r6:digit",
            f"tactile experiment {ARCHIVE} --out {{out}}/x --pairs r6",
            f"tactile experiment {ARCHIVE} --out {{out}}/x --preset none",
            f"tactile experiment {ARCHIVE} --out {{out}}/x --set 'translators=[magic]'",
            f"tactile experiment {ARCHIVE} --out {{out}}/x --set wings=2",
            f"tactile experiment {ARCHIVE} --out {{out}}/x --jobs 0",
            "tactile experiment {out}/none.markers.zarr --out {out}/x",
        ),
        one_process=True,
    ),
    Case(
        "learning-demo",
        (
            "tactile sim archive examples/demo-learning/array-hard.yaml,"
            "examples/demo-learning/circle.yaml,examples/demo-learning/diamond-soft.yaml --tier layer "
            "--scale 0.025 --steps 4 --no-check --out {out}/demo.markers.zarr",
            "tactile experiment {out}/demo.markers.zarr --out {out} --preset demo "
            "--pairs array-hard:circle,array-hard:diamond-soft",
        ),
        look=("report/*.csv",),
        rtol_elsewhere=0.1,
        timeout=2400,
        slow=True,
        once=True,
    ),
)

CASES = (*RIG_CASES, *RECORDER_CASES, *SIM_CASES, *LEARNING_CASES, *WRONG_FILES.values())
