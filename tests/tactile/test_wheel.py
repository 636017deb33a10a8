"""The installed package: all files that the code opens, and a lab based on the wheel alone."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DATA: dict[str, list[str]] = PYPROJECT["tool"]["setuptools"]["package-data"]
PACKAGES = ("trajectories", "recorder", "rig", "sim", "learning", "tactile")
FOR_EACH = "*"


def _there() -> set[str]:
    """Return all tracked non-Python files of the packages."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *PACKAGES],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    return {name for name in listed if not name.endswith(".py") and (ROOT / name).exists()}


def _declared() -> dict[str, set[str]]:
    """Return the files matched by each pattern of the package data."""
    found = {}
    for package, patterns in DATA.items():
        folders = PACKAGES if package == FOR_EACH else (package.replace(".", "/"),)
        for pattern in patterns:
            found[f"{package}: {pattern}"] = {
                str(path.relative_to(ROOT))
                for folder in folders
                for path in (ROOT / folder).glob(pattern)
            }
    return found


def test_every_pattern_of_the_package_data_finds_a_file() -> None:
    assert not [pattern for pattern, found in _declared().items() if not found]


def test_every_file_that_is_no_python_is_package_data() -> None:
    assert _there() - set().union(*_declared().values()) == set()


def test_every_package_says_that_it_is_typed_and_is_in_the_wheel() -> None:
    for package in PACKAGES:
        assert (ROOT / package / "py.typed").is_file()
        assert f"{package}*" in PYPROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    for package in DATA:
        assert package == FOR_EACH or (ROOT / package.replace(".", "/") / "__init__.py").is_file()


SCRIPT = """
import numpy as np
from recorder import Session, Window

session = Session("SESSION")
frames = session.frames
wrench = np.asarray(frames["wrench"][:])
tick = int(frames["t_ns"][-1])
window: Window = session.window(tick, n=4)
assert window.wrench is not None and window.image is not None
print(session.status, wrench.shape[1], window.wrench.shape, window.image.shape)
"""


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_lab_works_from_the_wheel_alone(tmp_path: Path) -> None:
    """As for a user without the repository: a fresh venv, an empty folder."""
    clone, house = tmp_path / "clone", tmp_path / "wheels"
    _run("git", "clone", "-q", str(ROOT), str(clone), cwd=tmp_path)
    _run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", str(house), ".", cwd=clone)
    (wheel,) = house.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    assert _there() <= packed
    assert not [name for name in packed if name.startswith(("benchmarks/", "tests/"))]

    venv = tmp_path / "venv"
    _run(sys.executable, "-m", "venv", str(venv), cwd=tmp_path)
    python, tactile = str(venv / "bin" / "python"), str(venv / "bin" / "tactile")
    _run(python, "-m", "pip", "install", "-q", f"{wheel}[rig,sim]", "mypy", cwd=tmp_path)
    _run(tactile, "--help", cwd=tmp_path)
    _run(tactile, "init", "lab", cwd=tmp_path)
    lab = tmp_path / "lab"
    message = _run(tactile, "collect", "--sensor", "tacpalm", "--targets", "2", cwd=lab)
    assert message.startswith("MOCK BENCH (")
    (session,) = lab.glob("sessions/*.zarr")
    _run(tactile, "session", "info", str(session), cwd=lab)
    press = ("--shape", "sphere:radius=4", "--depths", "1")
    assert " 1.00" in _run(tactile, "sim", "press", *press, cwd=lab)
    script = lab / "read.py"
    script.write_text(SCRIPT.replace("SESSION", str(session)).lstrip())
    assert _run(python, str(script), cwd=lab).startswith("complete 6 (4, 6)")
    _run(python, "-m", "mypy", "--strict", str(script), cwd=lab)


def _run(*command: str, cwd: Path) -> str:
    """Run a command without the repository on its path, and return its output."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    ran = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, f"{command}:\n{ran.stdout}\n{ran.stderr}"
    return ran.stdout
