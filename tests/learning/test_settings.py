"""Settings: strict YAML to frozen values; every error states the place and the allowed values."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from learning.config import READER, read_settings, require, settings_to_dict
from learning.errors import LearningError
from recorder.settings import differing_keys


@dataclass(frozen=True, slots=True)
class Slow:
    KIND: ClassVar[str] = "slow"
    rate: float


@dataclass(frozen=True, slots=True)
class Fast:
    KIND: ClassVar[str] = "fast"
    rate: float
    boost: float = 2.0


@dataclass(frozen=True, slots=True)
class Inner:
    widths: tuple[int, ...] = (1, 2)
    box: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        if min(self.widths) < 1:
            raise LearningError(f"widths: found {self.widths}; allowed: 1 and more")


@dataclass(frozen=True, slots=True)
class Outer:
    steps: int
    rate: float = 1e-3
    name: Literal["a", "b"] = "a"
    limit: float | None = None
    source: str | int = 0
    on: bool = False
    inner: Inner = field(default_factory=Inner)
    speed: Slow | Fast = field(default_factory=lambda: Slow(1.0))
    stages: tuple[Slow, ...] = ()


FULL = """
steps: 5
rate: 1e-4
name: b
limit: 2
on: true
inner: {widths: [4, 8, 16], box: [0, 0.5]}
speed: {kind: fast, rate: 3}
stages: [{rate: 1}, {rate: 2}]
"""


@pytest.fixture
def presets(tmp_path: Path) -> Path:
    (tmp_path / "full.yaml").write_text(FULL)
    (tmp_path / "small.yaml").write_text("extends: full.yaml\nsteps: 2\n")
    return tmp_path


def test_every_kind_of_field_is_read(presets: Path) -> None:
    read = read_settings(Outer, presets, "full")
    assert read == Outer(
        5, 1e-4, "b", 2.0, 0, True, Inner((4, 8, 16), (0.0, 0.5)), Fast(3.0), (Slow(1.0), Slow(2.0))
    )


def test_overrides_win_in_their_order(presets: Path) -> None:
    given = ("steps=7", "inner.widths=[3]", "rate=2e-5", "steps=8", "speed={kind: slow, rate: 9}")
    read = read_settings(Outer, presets, presets / "small.yaml", given)
    assert (read.steps, read.rate, read.inner) == (8, 2e-5, Inner((3,), (0.0, 0.5)))
    assert read.speed == Slow(9.0)


def test_plain_values_make_the_same_settings_again(presets: Path) -> None:
    read = read_settings(Outer, presets, "full")
    assert READER.build(Outer, settings_to_dict(read), "again") == read


@dataclass(frozen=True)
class Ranged:
    steps: int | None = 1
    fraction: float = 0.5
    betas: tuple[float, float] = (0.0, 1.0)


@pytest.mark.parametrize(
    ("settings", "wanted", "message"),
    [
        (Ranged(steps=0), {"least": 1}, "steps: found 0; allowed: 1 or more"),
        (Ranged(steps=0), {"above": 0}, "steps: found 0; allowed: above 0"),
        (Ranged(fraction=1.5), {"least": 0, "most": 1}, "fraction: found 1.5; allowed: 0 to 1"),
        (Ranged(fraction=float("nan")), {"least": 0}, "fraction: found nan; allowed: 0 or more"),
        (
            Ranged(fraction=-1.0),
            {"above": 0, "most": 1},
            "fraction: found -1.0; allowed: above 0 to 1",
        ),
        (Ranged(betas=(0.0, 2.0)), {"most": 1}, r"betas: found \(0.0, 2.0\); allowed: 1 or less"),
    ],
)
def test_numbers_outside_their_range_are_refused_by_name(
    settings: Ranged, wanted: dict[str, float], message: str
) -> None:
    with pytest.raises(LearningError, match=f"^{message}$"):
        require(settings, message.split(":")[0], **wanted)
    require(Ranged(steps=None), "steps", "fraction", "betas", least=0, most=1)


def test_keys_that_differ_are_named_by_their_path() -> None:
    one = settings_to_dict(Outer(1))
    other = settings_to_dict(Outer(2, inner=Inner((3,)), speed=Fast(1.0)))
    assert differing_keys(one, other) == ["inner.widths", "speed.boost", "speed.kind", "steps"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rate: 1", "missing steps"),
        ("steps: 5\nlimit: x", ".limit: found text 'x'; allowed: a number"),
        ("steps: 5\nsource: 1.5", ".source: found 1.5; allowed: text, or a whole number"),
        ("steps: 5\ninner: {widths: 3}", ".inner.widths: found 3; allowed: a list"),
        ("steps: 5\ninner: {widths: [1, a]}", ".inner.widths[1]: found text 'a'; allowed: a whole"),
        ("steps: 5\ninner: {widths: [0]}", ".inner: widths: found (0,); allowed: 1 and more"),
        ("steps: 5\nspeed: {rate: 1}", ".speed.kind: missing; allowed: slow, fast"),
        ("steps: 5\nstages: [{kind: fast, rate: 1}]", ".stages[0].kind: found 'fast'"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "it.yaml"
    path.write_text(text)
    with pytest.raises(LearningError) as raised:
        read_settings(Outer, tmp_path, path)
    assert message in str(raised.value)
    assert str(tmp_path) in str(raised.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("steps", "--set: found 'steps'; allowed: key=value"),
        ("a..b=1", "--set: found 'a..b=1'"),
        ("nothing=1", "unknown nothing"),
        ("inner.depth=1", ".inner: unknown depth"),
        ("steps=[", "--set steps: not YAML"),
    ],
)
def test_wrong_overrides_are_refused(presets: Path, override: str, message: str) -> None:
    with pytest.raises(LearningError, match=re.escape(message)):
        read_settings(Outer, presets, "full", [override])
