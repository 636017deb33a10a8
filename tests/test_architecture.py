"""The house is built as its plan says: who may import whom, and who may touch the clock."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("trajectories", "recorder", "rig", "sim", "learning")
ALLOWED = {
    "trajectories": set(),
    "recorder": set(),
    "rig": {"trajectories", "recorder"},
    "sim": {"trajectories", "recorder"},
    "learning": {"trajectories", "recorder"},
}
# Vendor libraries and the only modules that may import them.
VENDORS = {
    "rtde_control": {"rig/arm"},
    "rtde_receive": {"rig/arm"},
    "dashboard_client": {"rig/arm"},
    "nidaqmx": {"rig/force"},
    "grpc": {"rig/force"},
    "serial": {"rig/force", "rig/gripper"},
    "hidraw": {"rig/hid"},
    "cv2": {
        "rig/camera",
        "rig/world",
        "recorder/importing",
        "rig/recording_cost/stores",
        "learning/markers",
        "learning/translation/flow",
    },
    "websockets": {"rig/taxels", "rig/watch"},
    "rerun": {"recorder/view"},
    "h5py": {"recorder/export", "rig/recording_cost/stores"},
    "mcap": {"recorder/export", "rig/recording_cost/stores"},
    "torch": {"learning", "rig/recording_cost/stores"},
    "warp": {"sim"},
    "scipy": {"sim", "learning/markers", "learning/translation/flow", "learning/evaluation"},
    "accelerate": {"learning"},
    "safetensors": {"learning/training", "learning/translation/diffusion"},
    "diffusers": {"learning/translation/diffusion"},
    "peft": {"learning/translation/diffusion"},
    "transformers": {"learning/translation/diffusion"},
    "sklearn": {"learning/evaluation"},
    "matplotlib": {"learning"},
    "onnxruntime": {"learning"},
    "mcap_protobuf": {"recorder/export"},
    "foxglove_schemas_protobuf": {"recorder/export"},
    "pyarrow": {"recorder/export"},
    "fsspec": {"recorder/remote"},
    "bpy": {"sim/render"},
    "trimesh": {"sim/indenters"},
    "distributed": {"sim/archives"},
}
LAZY = {"rig/world/simulated.py": {"sim"}, "rig/live/predictor.py": {"learning"}}
"""What a module may import inside of its functions alone."""
MODULES = sorted(
    path for package in PACKAGES for path in (ROOT / package).rglob("*.py") if path.is_file()
)


def _imports(path: Path) -> set[str]:
    return _imported_by(ast.walk(ast.parse(path.read_text())))


def _imported_by(nodes: Iterable[ast.AST]) -> set[str]:
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_there_are_modules_to_look_at() -> None:
    assert {path.relative_to(ROOT).parts[0] for path in MODULES} >= {
        "trajectories",
        "recorder",
        "rig",
    }


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_packages_import_only_what_lies_below_them(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    ours = _imports(path) & set(PACKAGES) - {package}
    allowed = ALLOWED[package] | LAZY.get(_name(path), set())
    assert ours <= allowed, f"{_name(path)} imports {sorted(ours - allowed)}"


@pytest.mark.parametrize("path", [path for path in MODULES if _name(path) in LAZY], ids=_name)
def test_what_may_be_imported_lazily_is_not_imported_with_the_module(path: Path) -> None:
    at_once = _imported_by(ast.parse(path.read_text()).body)
    assert not at_once & LAZY[_name(path)]


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_vendor_libraries_stay_in_their_own_folder(path: Path) -> None:
    for vendor, folders in VENDORS.items():
        if vendor in _imports(path):
            assert any(_name(path).startswith(folder) for folder in folders), (
                f"{_name(path)} imports {vendor}; allowed in {sorted(folders)}"
            )


@pytest.mark.parametrize(
    "path", [path for path in MODULES if _name(path).startswith("rig/")], ids=_name
)
def test_only_the_clock_touches_time(path: Path) -> None:
    if _name(path) != "rig/clock.py":
        assert "time" not in _imports(path), f"{_name(path)} imports time; use rig.clock"


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_files_hold_one_idea(path: Path) -> None:
    lines = len(path.read_text().splitlines())
    assert lines <= 400, f"{_name(path)} has {lines} lines: more than one idea?"
