"""The force of a sensor that nothing touches, in recordings that do not say when that was."""

import numpy as np
import pytest
from numpy.typing import NDArray

from recorder.convert.import_presses import Signal, find_no_contact
from recorder.convert.import_tracks import MissingAnswer

Floats = NDArray[np.float64]
RATE, SECONDS = 60.0, 8.0
TIMES = np.arange(int(SECONDS * RATE)) / RATE


def press(begin: float, end: float, force: float) -> Floats:
    """Return a force that rises and falls within half a second."""
    return force * np.clip(np.minimum((TIMES - begin) / 0.5, (end - TIMES) / 0.5), 0, 1)


def recorded(kind: str, peak: float, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the true and the measured pressing force (n,) [N] of a recording."""
    true = sum((press(1 + 2.2 * k, 2.6 + 2.2 * k, peak) for k in range(3)), np.zeros(len(TIMES)))
    wrong = np.zeros(len(TIMES))
    if kind == "one":
        true = press(1.5, 4.5, peak)
    if kind == "ends in contact":
        true = press(2, 99, peak)
    if kind == "begins in contact":
        true = peak * np.clip((3 - TIMES) / 0.5, 0, 1)
    if kind == "begins in contact, comes back":
        true = peak * np.clip((2 - TIMES) / 0.5, 0, 1) + press(3.5, 5.5, 0.8 * peak)
    if kind in ("dip", "dip in contact"):
        begin = 1.7 if kind == "dip in contact" else random.uniform(0.2, 7)
        wrong -= random.uniform(1, 3) * peak * ((begin < TIMES) & (begin + 0.5 > TIMES))
    if kind == "glitch at the end":
        wrong[-random.integers(1, 4) :] -= 70
    if kind == "adhesion":
        for end in np.flatnonzero((true[:-1] > 0) & (true[1:] == 0)):
            wrong[end : end + 15] -= 0.15 * peak
    if kind == "drift":
        wrong += np.linspace(0, 0.05 * peak, len(TIMES))
    if kind.startswith("other sign"):
        true = press(1.5, 99 if "ends" in kind else 4.5, peak)
        wrong = -2 * true
    return true, true + wrong + random.normal(0, 0.005 * peak, len(TIMES))


TOLD = ("many", "one", "ends in contact", "glitch at the end", "drift", "adhesion")
TOLD += ("begins in contact, comes back",)
SEEN = ("dip",)
UNTOLD = ("begins in contact", "other sign", "other sign, ends in contact", "dip in contact")


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("kind", [*TOLD, *SEEN, *UNTOLD])
def test_zero_is_the_force_without_contact_or_is_asked_for(kind: str, seen: bool) -> None:
    random = np.random.default_rng(len(kind))
    answered = 0
    for _ in range(12):
        peak = float(random.choice([1.0, 3.0, 10.0, 60.0]))
        zero = float(random.normal(0, peak))
        true, pressing = recorded(kind, peak, random)
        pressing += zero
        t_ns = np.round(TIMES * 1e9).astype(np.int64)
        pictures = np.sqrt(true / peak)[:, None] * np.linspace(10, 40, 30)
        pictures += random.normal(0, 0.5, pictures.shape)
        force = Signal("force [N]", t_ns, pressing[:, None], pressing)
        try:
            begin, end = find_no_contact(force, "r", Signal("i", t_ns, pictures) if seen else None)
        except MissingAnswer:
            continue
        answered += 1
        found = float(pressing[(t_ns >= begin) & (t_ns < end)].mean())
        assert abs(found - zero) < 0.03 * peak
    if kind in TOLD:
        assert answered == 12
    if kind in SEEN and seen:
        assert answered >= 9
