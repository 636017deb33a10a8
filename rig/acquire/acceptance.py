"""Record of a bench's set-up, and the acceptance report made of it.

`calibrations/<sensor>.setup.json` has the answers and findings of every step, so that a stopped
set-up continues. Once every step is done, its `acceptance` is what sessions carry, and
`<sensor>.acceptance.html` is the report to print and sign.
"""

import base64
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from recorder.pages import render
from recorder.store import replace_file
from rig.acquire.calibration.store import bench_hash, now_utc, read_setup, report_path, setup_path
from rig.acquire.doctor import Finding
from rig.bench.bench import BenchFile
from rig.core.errors import ConfigError


class SetupRecord:
    """Steps of the set-up of a bench file, in a folder of calibrations after each of them."""

    def __init__(self, folder: Path, file: BenchFile) -> None:
        bench = file.bench
        self.path = setup_path(folder, bench.sensor)
        self._bench = bench
        self._content = file.content
        stored = read_setup(folder, bench)
        self.steps: dict[str, dict[str, Any]] = stored.get("steps", {})
        """Answers and findings of each step, by its name."""
        self.answers: dict[str, float] = stored.get("answers", {})
        """Latest answer to each question."""
        self.accepted: dict[str, Any] | None = stored.get("acceptance")
        """Summary of the report; None before the end."""
        self._running: dict[str, Any] | None = None

    @property
    def report(self) -> Path:
        """Path of the report."""
        return report_path(self.path.parent, self._bench.sensor)

    def done(self, name: str, keys: Sequence[str]) -> bool:
        """Return True if a step is finished, and the sections of the file it checked stayed."""
        step = self.steps.get(name)
        return step is not None and step["keys_sha256"] == self._digest(keys)

    def show(self, name: str, number: int, count: int, findings: Sequence[Finding] = ()) -> None:
        """Store the step that is under way, with its findings before a person decides on them."""
        step = {"step": name, "number": number, "count": count, "pid": os.getpid()}
        self._running = {**step, "findings": [asdict(each) for each in findings]}
        self._write()

    def answer(self, name: str, value: float) -> None:
        """Keep the answer to a question, whatever becomes of its step."""
        self.answers[name] = value
        self._write()

    def add(
        self,
        name: str,
        keys: Sequence[str],
        answers: Mapping[str, Any],
        findings: Sequence[Finding],
    ) -> None:
        """Store a finished step; an earlier acceptance no longer holds."""
        states = {each.state for each in findings}
        self.steps[name] = {
            "date_utc": now_utc(),
            "state": next((state for state in ("FAULT", "note") if state in states), "well"),
            "answers": dict(answers),
            "findings": [asdict(each) for each in findings],
            "keys_sha256": self._digest(keys),
        }
        self.accepted = self._running = None
        self._write()

    def keep_picture(self, name: str, content: bytes) -> None:
        """Keep a picture for the report, such as `camera.jpeg` or `press.png`."""
        self._replace(self.path.with_suffix(f".{name}"), content)

    def accept(self, names: Sequence[str], operator: str) -> None:
        """Write the report of all steps, in order, and the summary that sessions carry."""
        steps = {name: self.steps[name] for name in names}
        faults = [name for name in names if steps[name]["state"] == "FAULT"]
        summary = {
            "date_utc": now_utc(),
            "operator": operator,
            "mock": self._bench.mock,
            "result": f"accepted with faults: {', '.join(faults)}" if faults else "accepted",
            "steps": {name: step["state"] for name, step in steps.items()},
            "bench_sha256": bench_hash(self._content),
            "steps_sha256": bench_hash(steps),
            "report": self.report.name,
        }
        page = render(
            Path(__file__).with_name("acceptance.html"),
            bench=self._bench,
            summary=summary,
            steps=steps,
            pictures={
                Path(path.stem).suffix[1:]: f"data:image/{path.suffix[1:]};base64,"
                + base64.b64encode(path.read_bytes()).decode()
                for path in sorted(self.path.parent.glob(f"{self.path.stem}.*.*g"))
            },
        )
        self.accepted = summary
        self._write()
        self._replace(self.report, page.encode())

    def _digest(self, keys: Sequence[str]) -> str:
        return bench_hash({key: self._content.get(key) for key in keys})

    def _write(self) -> None:
        stored = {
            "sensor": self._bench.sensor,
            "mock": self._bench.mock,
            "steps": self.steps,
            "answers": self.answers,
            "acceptance": self.accepted,
            **({"running": self._running} if self._running else {}),
        }
        self._replace(self.path, json.dumps(stored, indent=1).encode())

    def _replace(self, path: Path, content: bytes) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(path, content)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written ({error})") from error
