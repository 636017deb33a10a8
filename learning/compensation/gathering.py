"""Priors of an archive's sensors, from wherever there are force-depth curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from learning.compensation.curves import ForceDepth, curve_of_session, curve_of_table
from learning.compensation.labels import depth_range
from learning.compensation.prior import Prior, fit_prior, prior_of_coefficients
from learning.errors import LearningError
from learning.genforce.coefficients import Compensation, read_compensation
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor


@dataclass(frozen=True, slots=True)
class Curves:
    """Where force-depth curves come from, beside the archive's own rows."""

    sessions: Sequence[Path] = ()
    """Sessions of `python -m rig force-depth`; they say which sensor they are of."""
    coefficients: Path | None = None
    """Folder of <sensor>_down.csv and <sensor>_up.csv, as published."""
    per_mm: bool = True
    """Whether published coefficients are of depth in mm; else of its share of the range."""
    ranges_mm: Mapping[str, float] = field(default_factory=dict)
    """Depth that counts as 1, by sensor [mm], in place of the deepest located press."""


@dataclass(frozen=True, slots=True, eq=False)
class Gathered:
    """Priors, and what they were fitted to."""

    priors: Mapping[str, Prior]
    """By sensor."""
    measured: Mapping[str, ForceDepth]
    """By sensor; not of those whose coefficients were given."""
    without: tuple[str, ...]
    """Sensors of which nothing is known."""


def gather_priors(archive: MarkerArchive, curves: Curves) -> Gathered:
    """Return the priors of an archive's sensors.

    Of each sensor the first is taken of: a session, published coefficients, force-depth rows of
    the archive, coefficients that were imported with it.

    Raises:
        LearningError: A sensor that the archive does not have, or a curve that cannot be fitted.
        SessionError: A damaged session or archive.
    """
    sessions = {curve.sensor: curve for curve in map(curve_of_session, curves.sessions)}
    published = {} if curves.coefficients is None else read_compensation(curves.coefficients)
    for name in (*sessions, *curves.ranges_mm):
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name}; known: {', '.join(archive)}")
    priors: dict[str, Prior] = {}
    measured: dict[str, ForceDepth] = {}
    for name, sensor in archive.items():
        span = depth_range(sensor)
        if name in curves.ranges_mm:
            span = 1e-3 * curves.ranges_mm[name]
        curve = sessions.get(name)
        known = published.get(name)
        if curve is None and known is None:
            curve = curve_of_table(name, sensor.table, archive.indenters)
        if curve is not None:
            measured[name] = curve
            priors[name] = fit_prior(curve, span)
            continue
        source = "published coefficients"
        if known is None:
            known, source = _imported(sensor), "coefficients imported with the archive"
        if known is None:
            continue
        if span is None:
            raise LearningError(
                f"{name}: has coefficients and no located press that would say how deep it was "
                "pressed; allowed: --range-mm"
            )
        priors[name] = prior_of_coefficients(
            name, known, depth_range=span, per_mm=curves.per_mm, source=source
        )
    return Gathered(priors, measured, tuple(name for name in archive if name not in priors))


def _imported(sensor: ArchivedSensor) -> Compensation | None:
    """Return the coefficients that were imported with a sensor; None without."""
    known = sensor.attrs.get("force_depth")
    if known is None:
        return None
    try:
        return Compensation(
            tuple(float(value) for value in known["down"]),
            tuple(float(value) for value in known["up"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise LearningError(
            f"{sensor.name}.force_depth: found {known!r}; allowed: down and up, numbers"
        ) from error
