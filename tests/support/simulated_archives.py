"""Small archives of simulated sensors for tests: tier `layer`, a few presses."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from sim.dataset import DatasetPlan, OpenArchive, Solving, Unit, begin, fill
from sim.dataset import plan as solving
from sim.dataset.run import make_here
from sim.layer import Layer
from sim.scene import Scene
from sim.sensors import sensor
from sim.tiers import simulate_many

if TYPE_CHECKING:
    from sim.tiers import Tier


LAYER = Solving(tier="layer")
COARSE = Layer(grid=48)
# A family of two skins and one of taxels: 5 units, two of them force-depth.
SKINS = DatasetPlan(
    "targets",
    (sensor("r6"), sensor("r18"), sensor("uskin")),
    indenters=("sphere", "cone"),
    solving=LAYER,
    fraction=0.01,
    steps=1,
    unit_presses=2,
    batch_size=2,
)
UNITS, IMAGES = 5, 2 * (2 + 3) * 5 + (4 + 3) * 5
_IN_USE = sensor("array-i")
# A sensor with all device variations, pressed only at its centre.
LIVED = replace(
    SKINS,
    sensors=(
        replace(
            _IN_USE,
            trajectory=None
            if _IN_USE.trajectory is None
            else replace(_IN_USE.trajectory, points=(1,)),
            force_depth=None,
        ),
    ),
    seed=5,
)


def make(path: Path, plan: DatasetPlan, units: Callable[[Sequence[Unit]], Any] = tuple) -> int:
    """Make an archive's missing units in this process; `units` chooses and orders them."""
    begun: OpenArchive = begin(path, plan)
    return fill(
        begun,
        lambda missing, inside: make_here(begun, units(missing), inside, device="cpu"),
        lambda fraction: None,
    )


@pytest.fixture(scope="module", autouse=True)
def solved_once() -> Iterator[None]:
    """Solve presses once, those of tier `layer` on a coarse grid."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solving, "simulate_many", _known)
        yield


@pytest.fixture
def own_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solve presses on the grid of the product, as worker processes do."""
    monkeypatch.setattr(solving, "simulate_many", simulate_many)


def _known(scenes: Sequence[Scene], tier: Tier, **options: Any) -> list[Any]:
    options.pop("progress", None)
    tier = COARSE if isinstance(tier, Layer) else tier
    return [_simulated(scene, tier, tuple(sorted(options.items()))) for scene in scenes]


@functools.cache
def _simulated(scene: Scene, tier: Tier, options: tuple[Any, ...]) -> Any:
    (outcome,) = simulate_many([scene], tier, **dict(options))
    return outcome
