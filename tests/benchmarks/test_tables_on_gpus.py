"""Tables and ablations run in parallel: order of starts and assignment to GPUs."""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "learning" / "tables" / "on_gpus.py"


@pytest.fixture(scope="module")
def on_gpus() -> ModuleType:
    spec = importlib.util.spec_from_file_location("on_gpus", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["on_gpus"] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module


def script(code: str) -> tuple[str, ...]:
    return sys.executable, "-c", code


def test_each_begins_once_what_it_needs_is_done(on_gpus: ModuleType, tmp_path: Path) -> None:
    made, used = tmp_path / "made", tmp_path / "used"
    tasks = [
        on_gpus.Task(
            "second",
            script(f"import os; open({str(used)!r}, 'w').write(open({str(made)!r}).read())"),
            ("first",),
            jobs=1,
        ),
        on_gpus.Task(
            "first",
            script(
                f"import os; open({str(made)!r}, 'w').write(os.environ['CUDA_VISIBLE_DEVICES'] + "
                "os.environ['DEVICE'] + os.environ['JOBS'])"
            ),
            environment=(("JOBS", "5"),),
        ),
    ]
    reported: list[str] = []
    took = on_gpus.run_all(tasks, on_gpus.Machine(["3"], 1), tmp_path, reported.append)
    assert list(took) == ["first", "second"]
    assert used.read_text() == "3cuda:05"
    assert [line.split("  ")[-1] for line in reported][::2] == [
        "first: begins, GPU 3",
        "second: begins, GPU 3",
    ]
    assert (tmp_path / "times.csv").read_text().splitlines()[0] == "piece,seconds"


def test_what_is_done_is_noted_whatever_else_fails_or_is_stopped(
    on_gpus: ModuleType, tmp_path: Path
) -> None:
    good, bad = (
        on_gpus.Task("own a", script("")),
        on_gpus.Task("own b", script("raise SystemExit(1)")),
    )
    machine = on_gpus.Machine(["0"], 1)
    assert on_gpus.done_in(tmp_path) == set()
    assert not on_gpus.run_on([good, bad], machine, tmp_path, None)
    assert on_gpus.done_in(tmp_path) == {"own a"}
    long = on_gpus.Task("long", script("import time; time.sleep(30)"))
    began = time.monotonic()
    assert not on_gpus.run_on([long], on_gpus.Machine(["0"], 1), tmp_path, 1)
    assert time.monotonic() < began + 20
    assert on_gpus.done_in(tmp_path) == {"own a"}
    assert on_gpus.run_on([good], on_gpus.Machine(["0"], 1), tmp_path, None)


def test_what_fails_takes_along_only_what_needs_it(on_gpus: ModuleType, tmp_path: Path) -> None:
    tasks = [
        on_gpus.Task("broken", script("raise SystemExit('no such sensor')"), jobs=1),
        on_gpus.Task("behind", script(""), ("broken",), jobs=1),
        on_gpus.Task("beside", script(""), jobs=1),
    ]
    reported: list[str] = []
    took = on_gpus.run_all(tasks, on_gpus.Machine(["0"], 4), tmp_path, reported.append)
    assert list(took) == ["beside"]
    assert "    no such sensor" in reported
    assert any("behind: skipped, it needs broken" in line for line in reported)


def test_stopped_it_stops_what_runs_and_waits_for_it(on_gpus: ModuleType, tmp_path: Path) -> None:
    ready, saved = tmp_path / "ready", tmp_path / "saved"
    training = (
        "import pathlib, time\n"
        "try:\n"
        f"    pathlib.Path({str(ready)!r}).touch()\n"
        "    time.sleep(60)\n"
        "except KeyboardInterrupt:\n"
        f"    pathlib.Path({str(saved)!r}).touch()\n"
    )

    def stop(line: str) -> None:
        while not ready.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        on_gpus.run_all(
            [on_gpus.Task("training", script(training), jobs=1)],
            on_gpus.Machine(["0"], 4),
            tmp_path,
            stop,
        )
    assert saved.exists()


def test_a_gpu_takes_as_many_models_as_it_has_memory_for(on_gpus: ModuleType) -> None:
    machine = on_gpus.Machine(["0", "1"], 10)
    table = on_gpus.Task("table", (), jobs=8)
    small = on_gpus.Task("small", (), jobs=2)
    for piece, place in ((table, 0), (table, 1), (small, 0), (small, 1), (small, None)):
        assert machine.place_for(piece) == place
        if place is not None:
            machine.running.append(on_gpus.Running(piece, place, None, 0.0))
    archive = on_gpus.Task("archive", ())
    assert machine.place_for(archive) is not None
    machine.running += [on_gpus.Running(archive, 0, None, 0.0)] * on_gpus.ARCHIVES_AT_ONCE
    assert machine.place_for(archive) is None


def test_a_table_too_large_for_a_gpu_has_one_for_itself(on_gpus: ModuleType) -> None:
    machine, table = on_gpus.Machine(["0"], 4), on_gpus.Task("table", (), jobs=8)
    assert machine.place_for(table) == 0
    machine.running.append(on_gpus.Running(table, 0, None, 0.0))
    assert machine.place_for(table) is None


def test_pieces_by_name_come_with_what_they_need(on_gpus: ModuleType, tmp_path: Path) -> None:
    known = on_gpus.tasks(tmp_path, 8, 16)
    names = {piece.name for piece in known}
    assert all(set(piece.needs) <= names for piece in known)
    assert [piece.name for piece in on_gpus.chosen(known, "half")] == [
        "archive heterogeneous",
        "heterogeneous",
        "ablation half",
    ]
    assert on_gpus.chosen(known, None) == known
    with pytest.raises(SystemExit, match=r"--only: found quart; allowed: .*ablation quarter"):
        on_gpus.chosen(known, "quart")
