"""The `layer` tier: a linear elastic layer bonded to a rigid base, solved by convolution.

Here are the settings, numerical choices and not physical properties; the solver is in
`sim.layer.solver`.
"""

from dataclasses import dataclass

from sim.errors import check_kind, check_range, make_plain


@dataclass(frozen=True, slots=True)
class Layer:
    """Pixels and tolerance of the `layer` tier.

    Raises:
        SceneError: A value is no number, or the tolerance is out of range.
    """

    grid: int = 128
    """Pixels along the body's longer side, 16 to 512. On a body of 20 mm, forces of spheres are
    within 0.1 % with 128."""
    tolerance: float = 2e-3
    """Target residual of the contact, 1e-10 to 0.1 (`Contact.residual`); changes forces by about a
    twentieth of it."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_kind("layer.grid", self.grid, int, "a whole number")
        check_range("layer", "tolerance", self.tolerance, 1e-10, 0.1)
