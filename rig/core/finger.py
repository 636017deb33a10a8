"""Force of a finger, which controls a grip, of any source."""

from dataclasses import dataclass

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class FingerForce:
    """Force on the sensor of a finger in one frame, in the sensor's own contact frame."""

    finger: str
    """Name of the sensor, such as `left`."""
    t_ns: int
    """Time of the state that the frame shows [ns], of the clock of this computer."""
    force: Triple
    """Fx, Fy, Fz [N]; pressing is negative Fz; NaN on axes that the model does not predict."""
    half_width: Triple
    """Half-widths of the 90 % intervals of the force [N]; NaN where they are unknown."""
    outside: bool
    """True if the frame is unlike those that the model learned from."""
    slipping: bool = False
    """True if the object slides over the skin."""
