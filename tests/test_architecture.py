"""Architecture rules: allowed imports between packages, and access to the clock."""

import ast
import functools
import itertools
from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("trajectories", "recorder", "rig", "sim", "learning", "tactile")
ALLOWED = {
    "trajectories": set(),
    "recorder": set(),
    "rig": {"trajectories", "recorder"},
    "sim": {"trajectories", "recorder"},
    "learning": {"trajectories", "recorder"},
    "tactile": {"recorder", "learning", "rig"},
}
# Vendor libraries and the only modules that may import them.
VENDORS = {
    "rtde_control": {"rig/devices/arm"},
    "rtde_receive": {"rig/devices/arm"},
    "dashboard_client": {"rig/devices/arm"},
    "nidaqmx": {"rig/devices/force"},
    "grpc": {"rig/devices/force"},
    "serial": {"rig/devices/force", "rig/devices/gripper"},
    "hidraw": {"rig/devices/hid"},
    "cv2": {
        "rig/acquire/signal_level",
        "rig/devices/camera",
        "rig/mock/world",
        "recorder/convert",
        "learning/markers",
        "learning/translation/flow",
    },
    "websockets": {"rig/devices/taxels", "rig/monitor"},
    "h5py": {"recorder/convert"},
    "mcap": {"recorder/convert"},
    "torch": {"learning"},
    "warp": {"sim"},
    "scipy": {"sim", "learning/markers", "learning/translation/flow", "learning/evaluation"},
    "accelerate": {"learning"},
    "safetensors": {"learning/training", "learning/translation/diffusion"},
    "diffusers": {"learning/translation/diffusion"},
    "peft": {"learning/translation/diffusion"},
    "transformers": {"learning/translation/diffusion"},
    "sklearn": {"learning/evaluation"},
    "matplotlib": {"recorder/charts"},
    "onnxruntime": {"learning"},
    "mcap_protobuf": {"recorder/convert"},
    "foxglove_schemas_protobuf": {"recorder/convert"},
    "pyarrow": {"recorder/convert"},
    "fsspec": {"recorder/store"},
    "trimesh": {"sim/indenters"},
}
# Imports that a module may make only inside its functions.
LAZY = {
    "rig/bench/expected.py": {"sim"},
    "rig/bench/indenter.py": {"sim"},
    "rig/mock/world/sensors.py": {"sim"},
    "rig/monitor/predictor.py": {"learning"},
    "tactile/force.py": {"sim"},
}
MODULES = sorted(
    path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.is_file()
)


@functools.cache
def _imports(path: Path) -> frozenset[str]:
    return _imported_by(ast.walk(ast.parse(path.read_text())))


def _imported_by(nodes: Iterable[ast.AST]) -> frozenset[str]:
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return frozenset(names)


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_there_are_modules_to_look_at() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in MODULES} == set(PACKAGES)
    assert {_name(path) for path in MODULES} >= LAZY.keys()


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_what_lies_below_them(package: str) -> None:
    others = set(PACKAGES) - {package} - ALLOWED[package]
    wrong = {
        _name(path): sorted(ours)
        for path in MODULES
        if path.is_relative_to(ROOT / package)
        and (ours := _imports(path) & others - LAZY.get(_name(path), set()))
    }
    assert not wrong, f"{package} may import {sorted(ALLOWED[package])}"


def test_nothing_stands_on_a_benchmark() -> None:
    wrong = [_name(path) for path in MODULES if _imports(path) & {"benchmarks", "tests"}]
    assert not wrong


@pytest.mark.parametrize("name", LAZY)
def test_what_may_be_imported_lazily_is_not_imported_with_the_module(name: str) -> None:
    at_once = _imported_by(ast.parse((ROOT / name).read_text()).body)
    assert not at_once & LAZY[name]


@pytest.mark.parametrize("vendor", VENDORS)
def test_vendor_libraries_stay_in_their_own_folder(vendor: str) -> None:
    folders = tuple(VENDORS[vendor])
    users = [_name(path) for path in MODULES if vendor in _imports(path)]
    wrong = [name for name in users if not name.startswith(folders)]
    assert not wrong, f"{vendor}: allowed in {sorted(folders)}"


def test_only_the_clock_touches_time() -> None:
    users = {_name(path) for path in MODULES if "time" in _imports(path)}
    wrong = {name for name in users if name.startswith("rig/")} - {"rig/core/clock.py"}
    assert not wrong, "use rig.core.clock"


@pytest.mark.parametrize(
    "package",
    [
        "recorder",
        "sim",
        "sim.markers",
        "sim.indenters",
        "recorder.archive",
        "recorder.markers",
        "learning",
        "learning.force",
        "learning.markers",
        "learning.translation",
    ],
)
def test_names_imported_on_demand_exist_and_are_no_submodules(package: str) -> None:
    module = import_module(package)
    with pytest.raises(AttributeError, match="no attribute 'Sitting'"):
        _ = module.Sitting
    for name in module.__all__:
        assert getattr(module, name) is not None
        # A folder that only keeps bytecode of an older version is found without an origin.
        assert getattr(find_spec(f"{package}.{name}"), "origin", None) is None


def test_no_module_builds_a_command_line_of_ours_to_run_it() -> None:
    """A function is called instead, where need be in a process of its own."""
    ours = {*PACKAGES, "benchmarks"}
    # An emulator is a process; the next command is put into words for a person to copy.
    emulator, next_command = "rig.mock.emulate", ROOT / "recorder/command_line/options.py"
    found = []
    for path in MODULES:
        text = path.read_text()
        if not any(word in text for word in ('"-m"', '"tactile"', "tactile.run")):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.List | ast.Tuple):
                words = [str(each.value) for each in node.elts if isinstance(each, ast.Constant)]
                after = [word for flag, word in itertools.pairwise(words) if flag == "-m"]
                ran = [word for word in after if word.partition(".")[0] in ours]
                found += [f"{path}: {word}" for word in ran if word != emulator]
                if words[:1] == ["tactile"] and path != next_command:
                    found.append(f"{path}: {words}")
            if (
                isinstance(node, ast.ImportFrom)
                and node.module == "tactile.run"
                and path.parent.name != "tactile"
            ):
                found.append(f"{path}: {node.module}")
    assert found == []
