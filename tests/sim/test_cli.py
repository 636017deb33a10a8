"""`tactile sim`: output, files, errors, and the examples of its documentation."""

import argparse
import importlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import label
from support.commands import python

from sim.cli import press as press_command
from sim.cli.options import indenter_of
from sim.errors import SimulationDiverged
from sim.layer import Layer
from sim.scene import Scene, beginning_of
from sim.store import load_result
from sim.tiers import simulate
from tactile.__main__ import main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "simulation.md").read_text()
QUICK = ["--tier", "layer"]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _said(argv: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    assert main(["sim", *argv, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_press_tells_the_force_at_the_depths_it_was_asked_for(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = "press --shape sphere:radius=4 --depths 0.5,1,1.5 --tier fem:0.4"
    told = _said(shlex.split(words), capsys)
    assert told["depth_mm"] == pytest.approx([0.5, 1.0, 1.5])
    # 0.2652, 0.9197, 1.9560 N on fine meshes.
    assert told["force_n"] == pytest.approx([0.2652, 0.9197, 1.9560], rel=0.15)
    assert told["effects"] == []
    assert told["tier"] == "fem"
    quality = told["quality"]
    assert max(quality["balance"]) < 1e-3
    assert min(quality["det_f_min"]) > 0.5
    assert quality["slip_excess"] == [None, None, None]
    assert sum(told["seconds_by_stage"].values()) <= told["seconds"]
    assert list(Path().iterdir()) == []


def test_a_round_body_is_said_and_softer_than_the_square_around_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = shlex.split("press --size 8,8,4 --depths 0.3 --tier fem:0.4 --footprint")
    assert main(["sim", *words, "ellipse"]) == 0
    assert "body 8x8x4 mm, ellipse, 0.145 MPa" in capsys.readouterr().out
    round_, square = (_said([*words, name], capsys) for name in ("ellipse", "rectangle"))
    assert 0 < round_["force_n"][0] < square["force_n"][0]


def test_the_standard_output_of_json_is_json_alone(tmp_path: Path) -> None:
    words = "-m tactile sim press --depths 0.2 --tier fem:0.3 --size 8,8,4 --json"
    done = python(*words.split(), folder=tmp_path)
    assert json.loads(done.stdout)["force_n"][0] > 0
    assert "warp" not in done.stderr.lower()


def test_without_json_there_is_a_table_and_a_picture(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "press", "--shape", "dots", "--depths", "0.2,0.4", *QUICK]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "press-dots.png"
    table = [line.split() for line in lines if re.match(r" +0\.[24]00 ", line)]
    assert [row[0] for row in table] == ["0.200", "0.400"]
    assert float(table[1][1]) > float(table[0][1]) > 0
    with Image.open("press-dots.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    # Five dots under pressure: as many red areas in the map on the right.
    right = pixels[105:530, 790:1220]
    assert label(right[..., 0] - right[..., 2] > 60)[1] == 5


def test_a_loop_shows_hysteresis_and_ends_free(capsys: pytest.CaptureFixture[str]) -> None:
    told = _said(
        shlex.split("press --depths 0.8 --shear 0.6 --angle 90 --steps 3 --friction 0.5") + QUICK,
        capsys,
    )
    force = np.array(told["wrench_n_nm"])
    assert len(force) == 12
    assert force[5, 1] > 0.1
    assert force[8, 1] < -0.01
    assert np.abs(force[:, 0]).max() < 0.01 * force[5, 1]
    assert np.abs(force[-1]).max() < 1e-6
    assert told["effects"] == ["friction"]


def test_a_hold_relaxes(capsys: pytest.CaptureFixture[str]) -> None:
    words = "press --depths 0.5 --hold 2 --steps 4 --viscosity 0.5:0.5"
    told = _said(shlex.split(words) + QUICK, capsys)
    force = np.array(told["force_n"])
    assert force.argmax() == 3
    assert (np.diff(force[3:]) < 0).all()
    assert told["time_s"][-1] == pytest.approx(2.05)


def test_a_hold_comes_before_a_shear(capsys: pytest.CaptureFixture[str]) -> None:
    words = "press --depths 0.2,0.4 --hold 1 --shear 0.3 --friction 0.5"
    told = _said(shlex.split(words) + QUICK, capsys)
    assert told["depth_mm"] == pytest.approx([0.2, 0.4, 0.4, 0.4, 0.4, 0.0])
    assert [tip[0] for tip in told["tip_mm"]] == pytest.approx([0, 0, 0, 0.3, 0, 0])
    assert np.diff([0, *told["time_s"]]) == pytest.approx([0.02, 0.02, 1, 0.03, 0.03, 0.04])


def test_values_that_begin_with_a_minus_are_no_options(capsys: pytest.CaptureFixture[str]) -> None:
    told = _said(["press", "--at", "-4,-2.5", "--depths", "0.3", *QUICK], capsys)
    assert told["tip_mm"] == [pytest.approx([-4.0, -2.5, -0.3])]


@pytest.mark.parametrize(
    ("shape", "measures", "area"),
    [
        ("punch", "radius=2,edge_radius=0", np.pi * 4),
        ("box", "width=3,length=4,edge_radius=0", 12.0),
        ("tube", "outer_radius=3,inner_radius=2,edge_radius=0", np.pi * 5),
    ],
)
def test_a_shape_has_the_measures_it_was_given(
    shape: str, measures: str, area: float, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = f"press --shape {shape}:{measures} --depths 0.05 --save x.zarr".split()
    _said([*argv, *QUICK], capsys)
    result = load_result(Path("x.zarr"))
    side = result.surface_x[1] - result.surface_x[0]
    touched = (result.traction[-1, :, :, 2] < 0).sum() * side**2 * 1e6
    # Contact is resolved on pixels 0.16 mm wide: half a pixel around the rim.
    assert touched == pytest.approx(area, rel=0.15)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("press --shape bla", r"--shape: 'bla'; allowed: sphere, .*punch"),
        ("press --shape prism:radius=3", r"--shape prism: radius given; allowed: edge_radius"),
        ("press --shape box:width=3", r"--shape box: width given; allowed: width, length"),
        ("press --shape sphere:radius=x", r"--shape sphere: radius=x; allowed: a number"),
        ("press --shape sphere:radius=1,radius=2", r"NAME:KEY=VALUE,\.\.\. with each key once"),
        ("press --shape torus:ring_radius=3,tube_radius=1,edge_radius=1", r"no edge"),
        ("press --shape x.stl:unit=ft", r"--shape x\.stl: unit=ft; allowed: unit=um"),
        ("press --shape x.stl:radius=1", r"--shape x\.stl: radius=1; allowed: unit, up, edge_rad"),
        ("press --poisson 0.5", r"body\.poisson: 0\.5; allowed: 0 to 0\.49995"),
        ("press --size 33,33,5.5 --dome 28.4 --footprint ellipse", r"body\.dome_radius: 0\.028"),
        ("press --depths 5", r"5 mm deep into a body 4 mm thick; allowed"),
        ("press --speed 0", r"motion\.speed: 0\.0 m/s"),
        ("press --device cuda:7 --tier fem", r"--device: 'cuda:7'; allowed here: cpu"),
        ("press --tolerance 2% --tier fem:2", r"--tier: fem with a fineness and --tolerance"),
        ("press --effects --out x.png", "--out: x.png with --effects; allowed: without"),
        ("press --effects --tolerance 2%", "--tolerance: 2% with --effects; allowed: without"),
        ("press --gravity", r"effects\.gravity: .*'fem'"),
        ("press --out x.jpg", r"--out: x\.jpg; allowed: a name that ends in \.png"),
        ("press --shear 0", "--shear: found '0'; allowed: a number above 0"),
        ("press --steps 0", "--steps: found '0'; allowed: whole numbers, 1 to 1000"),
        ("press --depths 1,x", "'1,x'; allowed: numbers between commas"),
        ("press --at 1", "'1'; allowed: 2 numbers between commas"),
        ("press --viscosity 0.5", r"'0\.5'; allowed: ratio:seconds between commas"),
        ("press --tier mpm", "'mpm'; allowed: layer, fem, or fem:FINENESS"),
        ("press --tier fem:99", "'fem:99'; allowed: layer, fem, or fem:FINENESS"),
    ],
)
def test_wrong_input_is_named_and_nothing_is_written(
    words: str, message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # The last --tier counts: those in the rows are for `fem`.
    command, *rest = words.split()
    assert main(["sim", command, *QUICK, *rest]) == 2
    captured = capsys.readouterr()
    assert re.match(f"wrong input: .*{message}", captured.err)
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []


def test_results_are_kept_whole_and_never_overwritten(capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["press", "--shape", "moon", "--depths", "0.2", "--save", "kept/x.zarr", *QUICK]
    told = _said(argv, capsys)
    assert -load_result(Path("kept/x.zarr")).force[1:, 2] == pytest.approx(told["force_n"])
    assert main(["sim", *argv]) == 2
    assert "--save: kept/x.zarr exists" in capsys.readouterr().err


def test_no_solution_is_told_with_what_was_tried(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverge(*_given: object, **_named: object) -> None:
        attempts = tuple(f"attempt {number}" for number in range(9))
        raise SimulationDiverged(
            "lost at 1 mm; state: /x/state.npz", attempts, Path("/x/state.npz")
        )

    monkeypatch.setattr(press_command, "simulate", diverge)
    assert main(["sim", "press", *QUICK]) == 1
    message = capsys.readouterr().err
    assert message.startswith("no solution: lost at 1 mm; state: /x/state.npz")
    assert "tried: attempt 8" in message
    assert list(Path().iterdir()) == []


def test_what_was_reached_is_shown_and_kept_before_there_is_no_solution(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverge(scene: Scene, tier: Layer, **_named: object) -> None:
        lost = SimulationDiverged("lost on the way to waypoint 2")
        lost.reached = simulate(beginning_of(scene, 2), tier)
        raise lost

    monkeypatch.setattr(press_command, "simulate", diverge)
    argv = ["sim", "press", "--depths", "0.2,0.4", "--save", "x.zarr", "--out", "x.png", *QUICK]
    assert main(argv) == 1
    told = capsys.readouterr()
    assert "0.200" in told.out
    assert "0.400" not in told.out
    assert told.err.startswith("no solution: lost on the way to waypoint 2")
    assert len(load_result(Path("x.zarr")).force) == 2
    assert Path("x.png").exists()


def test_ctrl_c_ends_with_130_and_leaves_nothing(tmp_path: Path) -> None:
    # Slow enough to be stopped: 200 depths on a mesh of 5,400 elements.
    depths = ",".join(f"{0.005 * step:g}" for step in range(1, 201))
    process = subprocess.Popen(
        [sys.executable, "-m", "tactile", "sim", "press", "--depths", depths, "--save", "x.zarr"],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
    )
    assert process.stderr is not None
    # The first progress line: the command is running.
    assert "press: " in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=240)
    assert process.returncode == 130
    assert "interrupted; nothing was written" in rest
    assert list(tmp_path.iterdir()) == []


def _blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


COMMANDS = [
    line.split("#")[0].strip()
    for block in _blocks("sh")
    for line in block.splitlines()
    if line.startswith("tactile sim press")
]


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_of_the_documentation_run(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(shlex.split(command)[1:]) == 0
    assert capsys.readouterr().out


def test_the_commands_of_the_tutorial_are_understood() -> None:
    # At the default mesh they take too long to be run here.
    text = (ROOT / "docs" / "tutorials" / "simulate-a-press.md").read_text()
    commands = re.findall(r"^tactile (sim [^#\n]*)", text, re.MULTILINE)
    assert len(commands) >= 2
    for command in commands:
        _, command, *words = shlex.split(command)
        parser = argparse.ArgumentParser()
        importlib.import_module(f"sim.cli.{command}").add_arguments(parser)
        assert indenter_of(parser.parse_args(words)).parts


def test_the_python_of_the_documentation_runs() -> None:
    names: dict[str, object] = {}
    source = "\n".join(_blocks("python"))
    assert source.count('"1 %"') == 1
    source = source.replace('"1 %"', '"5 %"')  # on meshes that take a tenth of the time
    exec(compile(source, "docs/reference/simulation.md", "exec"), names)
    assert len(COMMANDS) >= 4
    assert Path("presses.zarr").is_dir()


def test_the_help_has_every_option_of_the_documentation_and_a_unit_for_every_number(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["sim", "press", "--help"])
    text = capsys.readouterr().out
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", PAGE))
    assert named
    assert {option for option in named if option not in text} == set()
    assert text.count("[mm]") >= 6
    for unit in ("[MPa]", "[deg]", "[m/s^2]", "[kg/m^3]", "[s]"):
        assert unit in text
