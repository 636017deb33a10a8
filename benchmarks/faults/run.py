"""Run all rows one after the other, report progress, and write the page."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.faults import disk
from benchmarks.faults.judge import FaultResult
from benchmarks.faults.kills import Kills, kill_often
from benchmarks.faults.one_row import run_row
from benchmarks.faults.rows import ROWS, Row
from recorder.progress import duration
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import ConfigError

KILLS = "kills"
# Duration of each on two cores, used only to estimate the remaining time [s].
_ROW_SECONDS, _KILL_SECONDS, _RESUME_SECONDS = 11.0, 8.0, 25.0
_KILLS_A_SESSION = 10


def names() -> list[str]:
    """Return the values that --only accepts, in the order of running."""
    return [*(row.name for row in ROWS), disk.ROW.name, KILLS]


@dataclass(slots=True)
class Results:
    """Results of all rows."""

    rows: list[tuple[Row, FaultResult]] = field(default_factory=list)
    """Rows that were run, in order."""
    skipped: list[tuple[str, str]] = field(default_factory=list)
    """Name and reason of each skipped row."""
    kills: Kills | None = None
    seconds: float = 0.0
    """Total duration [s]."""

    @property
    def wrong(self) -> list[str]:
        """All failures."""
        found = [f"{row.name}: {what}" for row, judged in self.rows for what in judged.wrong]
        return found + (self.kills.wrong if self.kills is not None else [])


class Campaign:
    """Runner of the rows.

    Args:
        benches: Folder of the bench files.
        only: Names of the rows to run.
        kills: Number of kill -9s.
        seed: Random seed of the kills.
        keep: Folder for the files of failed rows; None: deleted.
    """

    def __init__(
        self, benches: Path, *, only: tuple[str, ...], kills: int, seed: int, keep: Path | None
    ) -> None:
        self._benches = benches
        self._kills = kills if KILLS in only else 0
        self._sessions = max(1, round(self._kills / _KILLS_A_SESSION)) if self._kills else 0
        self._seed = seed
        self._keep = keep
        self._rows = [row for row in ROWS if row.name in only]
        self._disk = disk.ROW.name in only
        self._clock = SystemClock()
        self._start_ns = self._clock.now_ns()
        self._done = 0.0
        self._total = (
            _ROW_SECONDS * (len(self._rows) + 2 * self._disk)
            + _KILL_SECONDS * self._kills
            + _RESUME_SECONDS * self._sessions
        )
        self.results = Results()

    def run(self, out: Path | None) -> bool:
        """Run the rows and write the page to `out`, if given; return True if all passed."""
        from benchmarks.faults.page import page

        for row in self._rows:
            with tempfile.TemporaryDirectory(prefix="tactile-rig-faults-") as scratch:
                try:
                    judged = run_row(row, Path(scratch), self._benches)
                except ConfigError as error:
                    self.results.skipped.append((row.name, str(error)))
                    self._say(f"{row.name}: skipped, {error}", _ROW_SECONDS)
                else:
                    self._note(row, judged, Path(scratch))
        if self._disk:
            self._fill_disk()
        if self._kills:
            self._kill()
        self.results.seconds = (self._clock.now_ns() - self._start_ns) / SECOND_NS
        wrong = self.results.wrong
        for what in wrong:
            print(f"FAILED: {what}")
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            beside = out.with_name(f"{out.name}.part")
            beside.write_text(page(self.results, self._benches))
            beside.replace(out)
            print(f"{out}: written")
        print(f"{'all passed' if not wrong else f'{len(wrong)} failures'}")
        return not wrong

    def _note(self, row: Row, judged: FaultResult, folder: Path) -> None:
        self.results.rows.append((row, judged))
        noticed = "" if judged.noticed is None else f", noticed after {judged.noticed:.2f} s"
        self._say(
            f"{row.name}: exit {judged.code}{noticed}, {judged.shown} samples looked for, "
            f"{judged.lost} lost, arm {judged.arm}{', WRONG' if judged.wrong else ''}",
            _ROW_SECONDS,
        )
        if judged.wrong and self._keep is not None:
            shutil.copytree(folder, self._keep / row.name, dirs_exist_ok=True)

    def _fill_disk(self) -> None:
        with tempfile.TemporaryDirectory(prefix="tactile-rig-faults-") as scratch:
            try:
                self._note(disk.ROW, disk.fill_disk(Path(scratch), self._benches), Path(scratch))
            except disk.CannotMount as error:
                self.results.skipped.append((disk.ROW.name, f"needs root for a tmpfs: {error}"))
                self._say(f"{disk.ROW.name}: skipped, {error}", 2 * _ROW_SECONDS)

    def _kill(self) -> None:
        with tempfile.TemporaryDirectory(prefix="tactile-rig-faults-") as scratch:
            self.results.kills = kill_often(
                Path(scratch),
                self._benches,
                kills=self._kills,
                sessions=self._sessions,
                seed=self._seed,
                report=lambda line: self._say(
                    line, _KILL_SECONDS if line.startswith("kill") else _RESUME_SECONDS
                ),
            )
            if self.results.kills.wrong and self._keep is not None:
                shutil.copytree(scratch, self._keep / KILLS, dirs_exist_ok=True)

    def _say(self, line: str, weight: float) -> None:
        self._done = min(self._done + weight, self._total)
        passed = (self._clock.now_ns() - self._start_ns) / SECOND_NS
        left = passed * (self._total - self._done) / self._done
        print(f"[{self._done / self._total:4.0%}, {duration(left)} left] {line}", flush=True)
