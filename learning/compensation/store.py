"""The compensation file: priors of sensors, and what was chosen for each pair, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.compensation.choosing import Choice
from learning.compensation.correction import compensate, require_choice
from learning.compensation.prior import Branch, Prior
from learning.errors import LearningError
from recorder.store.durable import replace_file

FORMAT, FORMAT_VERSION = "tactile-rig compensation", 1
CHOICES = ("default", "priors", "oracle")
"""Names of choices: fixed; by how well the priors fit; by the target's labels."""
CRITERIA = {
    "default": "d0 0, lambda 0.75, whatever the sensors (or as told on the command line)",
    "priors": "least expected error of the compensated force-depth curve, from the fits' residuals",
    "oracle": "least mean distance between compensated labels and the target's own at paired "
    "locations of training presses [N]",
}
UNITS = "d0: share of the source's depth range; depths m; forces, errors and residuals N"


@dataclass(frozen=True, slots=True)
class PairCompensation:
    """What is done to the labels of one sensor for another: `learning.force.labels` calls it."""

    source: Prior
    target: Prior
    d0: float
    """Share of the source's depth range up to which nothing is changed."""
    weight: float
    """Lambda."""

    def applied(
        self,
        wrench: NDArray[np.floating],
        depth: NDArray[np.float64],
        phase: NDArray[np.integer],
    ) -> tuple[NDArray[np.float64], int]:
        """Return labels (n, 3) or (n, 6) as the target would give them, and how many were clamped.

        Raises:
            LearningError: See `compensate`.
        """
        return compensate(wrench, depth, phase, self.source, self.target, self.d0, self.weight)


@dataclass(frozen=True, slots=True)
class StoredPair:
    """Choices for one directed pair of sensors."""

    source: str
    target: str
    before: Choice
    """Without compensation."""
    choices: Mapping[str, Choice]
    """By the names of `CHOICES`; those that could not be made are left out."""
    pairs: int = 0
    """Location pairs that errors are of."""


@dataclass(frozen=True, slots=True)
class StoredCompensation:
    """What `python -m learning compensate` found."""

    priors: Mapping[str, Prior]
    """By sensor."""
    pairs: tuple[StoredPair, ...]
    made_from: str = ""
    where: str = field(default="", compare=False)
    """Its file, for errors."""

    def pair(self, source: str, target: str, choice: str = "default") -> PairCompensation:
        """Return what is done to labels of a source for a target.

        Args:
            source: Name of the sensor that labels are of.
            target: Name of the sensor that they are for.
            choice: One of `CHOICES`.

        Raises:
            LearningError: No such pair, or no such choice for it.
        """
        for found in self.pairs:
            if (found.source, found.target) == (source, target):
                if choice not in found.choices:
                    raise LearningError(
                        f"{self.where}: {source} to {target} has no choice {choice!r}; known: "
                        f"{', '.join(found.choices)}"
                    )
                chosen = found.choices[choice]
                return PairCompensation(
                    self.priors[source], self.priors[target], chosen.d0, chosen.weight
                )
        known = ", ".join(f"{found.source} to {found.target}" for found in self.pairs)
        raise LearningError(f"{self.where}: no pair {source} to {target}; known: {known}")

    def write(self, path: Path) -> None:
        """Write the file, whole or not at all.

        Raises:
            LearningError: Another one is there.
            OSError: It cannot be written.
        """
        text = self._text()
        if path.exists():
            if path.read_text(encoding="utf-8") == text:
                return
            raise LearningError(f"{path}: exists and says something else; allowed: another name")
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, text.encode())

    def _text(self) -> str:
        content = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "units": UNITS,
            "made_from": self.made_from,
            "criteria": CRITERIA,
            "priors": {name: asdict(prior) for name, prior in self.priors.items()},
            "pairs": [asdict(pair) for pair in self.pairs],
        }
        return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def read_stored(path: Path) -> StoredCompensation:
    """Return what a compensation file says.

    Raises:
        LearningError: Not there, no such file, of a newer format, or a key missing or wrong.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise LearningError(f"{path}: not JSON: {error}") from None
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise LearningError(f"{path}.format: found {found!r}; allowed: {FORMAT!r}")
    version = content.get("format_version")
    if version != FORMAT_VERSION:
        raise LearningError(f"{path}.format_version: found {version!r}; allowed: {FORMAT_VERSION}")
    try:
        priors = {name: _prior(prior) for name, prior in content["priors"].items()}
        pairs = tuple(_pair(pair) for pair in content["pairs"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise LearningError(f"{path}: damaged: {error!r}") from None
    for pair in pairs:
        for name in (pair.source, pair.target):
            if name not in priors:
                raise LearningError(
                    f"{path}.pairs: {name} has no prior; known: {', '.join(priors)}"
                )
    return StoredCompensation(priors, pairs, str(content.get("made_from", "")), str(path))


def _prior(content: Mapping[str, Any]) -> Prior:
    return Prior(
        str(content["sensor"]),
        _branch(content["loading"]),
        _branch(content["unloading"]),
        float(content["depth_range"]),
        float(content["depth_max"]),
        str(content["indenter"]),
        str(content["source"]),
    )


def _branch(content: Mapping[str, Any]) -> Branch:
    residual = content["residual"]
    return Branch(
        tuple(float(value) for value in content["coefficients"]),
        None if residual is None else float(residual),
        int(content["samples"]),
    )


def _pair(content: Mapping[str, Any]) -> StoredPair:
    return StoredPair(
        str(content["source"]),
        str(content["target"]),
        _choice(content["before"]),
        {str(name): _choice(choice) for name, choice in content["choices"].items()},
        int(content["pairs"]),
    )


def _choice(content: Mapping[str, Any]) -> Choice:
    d0, weight, error = float(content["d0"]), float(content["weight"]), content["error"]
    require_choice(d0, weight)
    return Choice(
        d0,
        weight,
        None if error is None else float(error),
        tuple(float(value) for value in content["axes"]),
        int(content["clamped"]),
        # Files of old do not say.
        None if (r2 := content.get("r2")) is None else float(r2),
    )
