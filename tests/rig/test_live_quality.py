"""Quality of a running collection: a planted fault of each kind is found, and only that one."""

from pathlib import Path
from typing import Any

import pytest
from support.live_quality import CLEARANCE, GELSIGHT, PLACES, USKIN, Part, picture, recording

from rig.bench.bench import Bench, bench_from
from rig.core.config import read_yaml
from rig.core.packaged import BENCHES
from rig.monitor.quality import LiveQuality, QualityRow

pytestmark = pytest.mark.slow


def wrong(judged: dict[str, QualityRow]) -> dict[str, tuple[str, str]]:
    return {name: (row.state, row.text) for name, row in judged.items() if row.state != "good"}


@pytest.mark.parametrize("bench", [GELSIGHT, USKIN], ids=lambda bench: bench.sensor)
def test_a_healthy_recording_is_good_in_everything(bench: Bench, tmp_path: Path) -> None:
    with recording(bench, tmp_path) as made:
        assert {row.state for row in made.quality.look()} == {"unknown"}
        for _ in range(4):
            judged = made.seconds(1)
        assert wrong(judged) == {}
        signal = ["markers", "camera drift"] if bench.camera else ["taxels drift"]
        assert list(judged) == [*signal, "force drift", "force"]
        # The last samples come when it is known where the tip was.
        assert judged["force"].text == "no anomaly in 3,993 samples"


def test_rows_of_earlier_runs_are_left_out(tmp_path: Path) -> None:
    with recording(USKIN, tmp_path) as made:
        made.second(force=lambda ms, load: (2.0, 0.0, 0.0))
        made.quality = LiveQuality(USKIN, made.path, CLEARANCE, 0)
        assert wrong(made.seconds(2)) == {}


RATING = USKIN.force_rating[2]


def pressed(most: float, limit: float = 1.0) -> Part:
    """Return a force that reaches a fraction of the rating, and is cut off at another one."""
    return lambda ms, load: (0.0, 0.0, -RATING * min(most * load, limit))


ODD: dict[str, tuple[str, str, dict[str, Any]]] = {
    "spike": (
        "watch",
        "1 x spike, the last at 0:02, Fx by +1.5",
        {"force": lambda ms, load: (1.5 * (ms == 300), 0.0, -3.0 * load)},
    ),
    "near": ("watch", "x sample near the rating, the last at 0:02, Fz", {"force": pressed(0.95)}),
    "beyond": ("fault", "sample beyond the rating, the last at 0:02, Fz", {"force": pressed(1.1)}),
    "saturation": (
        "fault",
        f"1 x saturation, the last at 0:02, Fz stays at {-0.9 * RATING:+.3f} N",
        {"force": pressed(1.5, limit=0.9), "noise": 0.0},
    ),
    "no contact": (
        "fault",
        "1 x force without contact, the last at 0:02, Fy of 1.0",
        {"force": lambda ms, load: (0.0, 1.0 - load, 0.0)},
    ),
    "status": ("fault", "1000 x invalid sample, the last at 0:02, status 0x", {"status": -1}),
    "outside": (
        "fault",
        "N with the tip outside of the box",
        {
            "force": lambda ms, load: (0.9, 0.0, 0.0),
            "tip": lambda ms, load: (1.01 * USKIN.limits.box_x[1], 0.0),
        },
    ),
}


@pytest.mark.parametrize(("state", "text", "fault"), ODD.values(), ids=ODD)
def test_odd_forces_are_found(state: str, text: str, fault: dict[str, Any], tmp_path: Path) -> None:
    with recording(USKIN, tmp_path) as made:
        assert wrong(made.seconds(2)) == {}
        made.second(**fault)
        judged = made.seconds(2)
        assert wrong(judged).keys() == {"force"}
        assert judged["force"].state == state
        # It is recorded, so it stays on the page.
        assert text in judged["force"].text


TAXELS_MAX = 0.1 * (USKIN.stand_ins.signal_max if USKIN.stand_ins else 0.0)


@pytest.mark.parametrize(
    ("bench", "drift", "state", "row", "text"),
    [
        (USKIN, {"force": lambda ms, load: (0.2, 0.0, -3.0 * load)}, "watch", "force", "0.20 of"),
        (USKIN, {"force": lambda ms, load: (-0.4, 0.0, -3.0 * load)}, "fault", "force", "0.40 of"),
        (USKIN, {"counts": lambda load: 5000.0 * load + 0.9 * TAXELS_MAX}, "good", "taxels", ""),
        (USKIN, {"counts": lambda load: 5000.0 * load + 1.1 * TAXELS_MAX}, "fault", "taxels", ""),
        (
            GELSIGHT,
            {"image": lambda load: picture(light=0.95)},
            "fault",
            "camera",
            "the light, the focus or the gel changed",
        ),
    ],
    ids=["force", "force much", "taxels", "taxels much", "camera"],
)
def test_a_drift_is_found(
    bench: Bench, drift: dict[str, Part], state: str, row: str, text: str, tmp_path: Path
) -> None:
    with recording(bench, tmp_path) as made:
        made.seconds(1)
        judged = made.seconds(2, **drift)
        drifted = judged.pop(f"{row} drift")
        assert drifted.state == state
        assert text in drifted.text
        # A zero that is off by more than is allowed without contact is an odd force too.
        assert wrong(judged).keys() == ({"force"} if row == "force" and state == "fault" else set())


def test_markers_that_are_lost_are_found_and_a_contact_may_hide_a_few(tmp_path: Path) -> None:
    with recording(GELSIGHT, tmp_path) as made:
        made.seconds(1)
        made.seconds(1, image=lambda load: picture(missing=2 * (load > 0)))
        for _ in range(2):
            judged = made.seconds(1, image=lambda load: picture(missing=2))
        assert wrong(judged).keys() == {"markers"}
        assert judged["markers"].state == "fault"
        assert judged["markers"].text.startswith(
            f"{len(PLACES) - 2} of {len(PLACES)} seen at rest (image "
        )
        # Seen again, but some of the images before have lost them.
        for _ in range(2):
            judged = made.seconds(1)
        assert judged["markers"].state == "good"
        assert "missing in " in judged["markers"].text


def test_a_sensor_without_a_preset_has_no_count(tmp_path: Path) -> None:
    content = {**read_yaml(BENCHES / "gelsight.yaml", BENCHES), "sensor": "nosuch"}
    with recording(bench_from(content, "b.yaml"), tmp_path) as made:
        for _ in range(2):
            judged = made.seconds(1)
        assert wrong(judged) == {
            "markers": ("unknown", "not counted: no preset detects markers of nosuch")
        }


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    quality = LiveQuality(USKIN, tmp_path / "s.zarr", CLEARANCE, 0)
    pose = tmp_path / "s.zarr" / "streams" / "pose"
    pose.mkdir(parents=True)
    (pose / "zarr.json").write_text("{")
    (row,) = quality.look()
    assert (row.name, row.state) == ("session", "fault")
    assert row.text.startswith(f"cannot be read: {pose}")
