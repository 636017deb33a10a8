"""The mistakes that can be planted in the solver, and the cases that must catch them."""

from __future__ import annotations

from dataclasses import fields

from sim.fem.numerics import Planted

CATCHERS: dict[str, tuple[str, ...]] = {
    "full-integration": ("poisson-0-49",),
    "nodal-contact": ("flat-punch-between-bounds", "flat-punch-off-the-grid"),
    "lagged-friction": ("lifted-while-it-slips", "full-stick-stiffens"),
    "energy-line-search": ("float32-reaches-its-tolerance",),
}
"""By mistake, the cheapest cases that fail with it: what `--planted all` runs."""

MISTAKES = tuple(CATCHERS)

WHAT: dict[str, str] = {
    "full-integration": "volume change taken at every Gauss point: elements lock near nu = 0.5",
    "nodal-contact": "contact looked for at nodes only",
    "lagged-friction": "friction limit taken from the step before",
    "energy-line-search": "steps accepted by a drop of the energy",
}


def planted(mistake: str | None) -> Planted:
    """The solver's switches with one mistake on, or none.

    Raises:
        ValueError: No such mistake.
    """
    if mistake is None:
        return Planted()
    name = mistake.replace("-", "_")
    if name not in {field.name for field in fields(Planted)}:
        raise ValueError(f"no mistake is called {mistake!r}; known: {', '.join(MISTAKES)}")
    return Planted(**{name: True})
