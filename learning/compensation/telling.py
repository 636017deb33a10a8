"""What was found, as tables for people and as a picture of the curves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from learning.compensation.choosing import Choice
from learning.compensation.gathering import Gathered
from learning.compensation.prior import Branch, Prior
from learning.compensation.store import CHOICES, StoredCompensation, StoredPair

_POINTS = 300
"""Measured points that are drawn of a curve, at most."""


def tables(found: StoredCompensation, gathered: Gathered) -> Iterator[str]:
    """Yield lines: a table of priors, then one of pairs, then what they come to."""
    yield f"{'sensor':<14}{'range':>9}  {'loading at 1/2, 1':>20}{'rms':>8}  " + (
        f"{'unloading':>20}{'rms':>8}  [N]"
    )
    for prior in found.priors.values():
        yield (
            f"{prior.sensor:<14}{1e3 * prior.depth_range:>6.2f} mm  {_said(prior, prior.loading)}"
            f"  {_said(prior, prior.unloading)}  {prior.source}"
        )
    if gathered.without:
        yield f"without a force-depth curve: {', '.join(gathered.without)}"
    yield ""
    yield f"{'labels of > for':<28}{'before':>8}" + "".join(f"{name:>24}" for name in CHOICES)
    for pair in found.pairs:
        name = f"{pair.source} > {pair.target}"
        cells = "".join(f"{_cell(pair.choices.get(choice)):>24}" for choice in CHOICES)
        yield f"{name:<28}{_newtons(pair.before):>8}{cells}"
    yield "mean distance of labels from the target's [N], (d0 of the depth range, lambda)"
    yield from _summary(found.pairs)


def draw_curves(found: StoredCompensation, gathered: Gathered, path: Path) -> None:
    """Draw measured forces and the polynomials through them, loading and unloading, as a PNG.

    Raises:
        OSError: It cannot be written.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    spans = [prior.depth_range for prior in found.priors.values()]
    alike = max(spans) - min(spans) < 0.05 * max(spans)
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    colours = colormaps["viridis"](np.linspace(0.0, 0.9, len(spans)))
    for loading, panel in zip((True, False), axes, strict=True):
        for colour, (name, prior) in zip(colours, found.priors.items(), strict=True):
            unit = 1e3 * prior.depth_range if alike else 1.0
            if name in gathered.measured:
                curve = gathered.measured[name]
                points = curve.loading if loading else curve.unloading
                points = points[:: max(1, len(points) // _POINTS)]
                share = points[:, 0] / prior.depth_range
                panel.plot(share * unit, points[:, 1], ".", color=colour, markersize=3, alpha=0.5)
            share = np.linspace(0.0, prior.share_max, 100)
            force = prior.branch(loading).compression(share)
            panel.plot(share * unit, force, color=colour, label=name)
        panel.set_title("loading" if loading else "unloading")
        panel.set_xlabel("depth [mm]" if alike else "depth, of the sensor's range")
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("compression [N]")
    axes[0].legend(fontsize="small")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _said(prior: Prior, branch: Branch) -> str:
    half, whole = branch.compression(np.array([0.5, 1.0]))
    rms = "-" if branch.residual is None else f"{branch.residual:.3f}"
    return f"{half:>11.2f} {whole:>8.2f}{rms:>8}"


def _newtons(choice: Choice) -> str:
    return "-" if choice.error is None else f"{choice.error:.3f}"


def _cell(choice: Choice | None) -> str:
    if choice is None:
        return "-"
    clamped = f" {choice.clamped}!" if choice.clamped else ""
    return f"{_newtons(choice)} ({choice.d0:.2f}, {choice.weight:g}){clamped}"


def _summary(pairs: tuple[StoredPair, ...]) -> Iterator[str]:
    known = [(pair, pair.before.error) for pair in pairs if pair.before.error is not None]
    if not known:
        yield "no target has labels of its own: no error, no oracle"
        return
    for name in CHOICES:
        after = [
            (before, choice.error)
            for pair, before in known
            if (choice := pair.choices.get(name)) is not None and choice.error is not None
        ]
        if not after:
            continue
        better = sum(error < before for before, error in after)
        mean = np.mean(after, axis=0)
        yield (
            f"{name:<8} {mean[0]:.3f} N before, {mean[1]:.3f} N after; better in {better} of "
            f"{len(after)} pairs"
        )
    if any(choice.clamped for pair in pairs for choice in pair.choices.values()):
        yield "n!: n labels whose ratio of priors was clamped to 0.1 .. 10"
