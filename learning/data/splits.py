"""Splits of an archive's presses into training, validation and test sets, stored as files.

Whole presses are split, never frames or pairs: a contact of the training set is in no test under
another sensor. Some presses of the trainable indenters go to `validation` and some to `new_press`;
all presses of other indenters are `new_indenter`. States of one press that have separate locations
stay together. Whole sensors can be held out as well.
"""

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from learning.config import read_json
from learning.errors import LearningError
from learning.training.run import generator
from recorder.archive import MarkerArchive
from recorder.store import replace_file

Role = Literal["train", "validation", "new_press", "new_indenter"]
# Roles of a press.
ROLES: tuple[Role, ...] = get_args(Role)
# File of a training's split, in its folder.
SPLIT = "split.json"
# Role of unknown locations and of frames without a location.
NO_ROLE = ""

_FORMAT, _VERSION = "tactile-rig split", 1
# A value that is a list, which may hold others.
_LIST = re.compile(r'(?<=": )\[(?:[^][]|\[[^][]*\])*\]')


@dataclass(frozen=True, slots=True)
class PressKey:
    """A press, or one state of it, and its role."""

    location: int
    """Equal across sensors."""
    indenter: str
    target: int
    """Its number within the indenter."""
    role: Role


@dataclass(frozen=True, slots=True)
class Split:
    """Roles of locations, and sensors that no model may be trained on."""

    presses: tuple[PressKey, ...]
    """Ascending by location."""
    held_out_sensors: tuple[str, ...] = ()
    """Names, in alphabetical order."""
    validation: float = 0.0
    """Requested fraction of the presses of seen indenters for validation."""
    new_press: float = 0.0
    """The same for `new_press`."""
    seed: int = 0

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the content, 64 hexadecimal digits."""
        return hashlib.sha256(self._text().encode()).hexdigest()

    def trained_on(self, indenters: Collection[str]) -> Self:
        """Return the split in which the presses of some indenters are trained on as well."""
        presses = (replace(p, role="train") if p.indenter in indenters else p for p in self.presses)
        return replace(self, presses=tuple(presses))

    def locations(self, role: Role) -> NDArray[np.int64]:
        """Return the locations of a role (n,), ascending."""
        require_role(role)
        return np.array([each.location for each in self.presses if each.role == role], np.int64)

    def role(self, location: NDArray[np.integer[Any]]) -> NDArray[np.str_]:
        """Return the role of each location (n,): one of `ROLES`, or `NO_ROLE`."""
        locations = np.array([each.location for each in self.presses], np.int64)
        roles = np.array([*(each.role for each in self.presses), NO_ROLE], "<U12")
        wanted = np.asarray(location, np.int64)
        index = np.minimum(np.searchsorted(locations, wanted), max(len(locations) - 1, 0))
        listed = locations[index] == wanted if len(locations) else np.zeros(wanted.shape, np.bool_)
        return np.where(listed, roles[index], NO_ROLE)

    def rows(
        self, table: Mapping[str, NDArray[Any]], role: Role | Sequence[Role]
    ) -> NDArray[np.int64]:
        """Return the valid rows of a sensor's table in one or more roles, by location and frame."""
        wanted: Sequence[str] = (role,) if isinstance(role, str) else role
        for each in wanted:
            require_role(each)
        chosen = np.flatnonzero(
            table["valid"] & np.isin(self.role(table["location"]), list(wanted))
        )
        order = np.lexsort((table["frame"][chosen], table["location"][chosen]))
        return chosen[order].astype(np.int64)

    def trained_sensors(self, archive: MarkerArchive) -> tuple[str, ...]:
        """Return the sensors of an archive that models may be trained on."""
        return tuple(name for name in archive if name not in self.held_out_sensors)

    def check(self, archive: MarkerArchive) -> None:
        """Reject an archive with other presses than the split's; a subset is allowed."""
        by_location = {each.location: each for each in self.presses}
        for location, (indenter, target) in presses_of(archive).items():
            press = by_location.get(location)
            if press is None:
                raise LearningError(
                    f"{archive.name}: location {location} ({indenter}, target {target}) is not in "
                    "the split; allowed: archives of the presses that it was made from"
                )
            if (press.indenter, press.target) != (indenter, target):
                raise LearningError(
                    f"{archive.name}: found location {location} to be target {target} of "
                    f"{indenter}; the split knows it as target {press.target} of {press.indenter}"
                )

    def write(self, path: Path) -> None:
        """Write it as JSON. An equal file is left unchanged."""
        if path.exists():
            if read_split(path) != self:
                raise LearningError(f"{path}: holds another split; remove it, or choose another")
            return
        replace_file(path, self._text().encode())

    def _text(self) -> str:
        indenters = sorted({each.indenter for each in self.presses})
        document = {
            "format": _FORMAT,
            "format_version": _VERSION,
            "seed": self.seed,
            "validation": self.validation,
            "new_press": self.new_press,
            "held_out_sensors": list(self.held_out_sensors),
            # By role and indenter: target and location of each press.
            "presses": {
                role: {
                    name: [
                        [each.target, each.location]
                        for each in self.presses
                        if (each.role, each.indenter) == (role, name)
                    ]
                    for name in indenters
                }
                for role in ROLES
            },
        }
        text = json.dumps(document, indent=2)
        # One line for each indenter is readable; one for each press would make thousands of lines.
        return _LIST.sub(lambda found: json.dumps(json.loads(found[0])), text) + "\n"


def training_split(
    archive: MarkerArchive, path: Path | None = None, unseen: Sequence[str] | None = None
) -> Split:
    """Return the split of a training: that of a file, or one made of the archive's presses.

    The one that is made depends on the presses alone, so all trainings on an archive have the same.
    `unseen` replaces the archive's list of indenters that no model may be trained on.
    """
    if path is None:
        return make_split(archive, unseen=unseen)
    if unseen is not None:
        raise LearningError("--unseen: found with --split; allowed: one of them")
    split = read_split(path)
    split.check(archive)
    return split


def make_split(
    archive: MarkerArchive,
    *,
    validation: float = 0.1,
    new_press: float = 0.1,
    held_out_sensors: Sequence[str] = (),
    seed: int = 0,
    unseen: Sequence[str] | None = None,
) -> Split:
    """Split the presses of a complete archive; the seed and the presses alone determine it.

    `validation` and `new_press` are fractions of the presses of seen indenters, each taken evenly
    from them, at least one press unless it is 0. No model may be trained on held-out sensors and on
    `unseen` indenters, by default the archive's.
    """
    for name, fraction in (("validation", validation), ("new_press", new_press)):
        if not 0 <= fraction < 1:
            raise LearningError(f"{name}: found {fraction}; allowed: 0 to less than 1")
    _require_among("held_out_sensors", held_out_sensors, archive)
    press_of = presses_of(archive)
    if unseen is None:
        codes = [sensor.table["indenter"][~sensor.table["seen"]] for sensor in archive.values()]
        unseen = [archive.indenters[code] for code in np.unique(np.concatenate(codes)).tolist()]
    else:
        _require_among("unseen", unseen, archive.indenters)
    states: dict[tuple[str, int], list[int]] = {}
    for location, press in sorted(press_of.items()):
        states.setdefault(press, []).append(location)
    seen = _shuffled([press for press in states if press[0] not in unseen], seed)
    counts = [
        max(1, round(fraction * len(seen))) if fraction else 0
        for fraction in (new_press, validation)
    ]
    if sum(counts) >= len(seen):
        raise LearningError(
            f"{archive.name}: found {len(seen)} presses of seen indenters, {counts[0]} for "
            f"new_press and {counts[1]} for validation; allowed: presses and fractions that leave "
            "some to train"
        )
    roles: dict[tuple[str, int], Role] = {press: "new_indenter" for press in states}
    for number, press in enumerate(seen):
        roles[press] = "new_press" if number < counts[0] else "validation"
        if number >= sum(counts):
            roles[press] = "train"
    presses = (
        PressKey(location, *press, roles[press])
        for press, locations in states.items()
        for location in locations
    )
    return Split(
        tuple(sorted(presses, key=lambda press: press.location)),
        tuple(sorted(held_out_sensors)),
        float(validation),
        float(new_press),
        seed,
    )


def split_by_indenters(archive: MarkerArchive, learned: Collection[str]) -> Split:
    """Return the split in which all presses of some indenters were learned, and no others."""
    presses = (
        PressKey(location, *press, "train" if press[0] in learned else "new_indenter")
        for location, press in sorted(presses_of(archive).items())
    )
    return Split(tuple(presses), (), 0.0, 0.0, 0)


def read_split(path: Path) -> Split:
    """Read a split from a file."""
    document = read_json(path)
    is_mapping = isinstance(document, dict)
    written = (document.get("format"), document.get("format_version")) if is_mapping else None
    if written != (_FORMAT, _VERSION):
        raise LearningError(f"{path}: found format {written}; allowed: {(_FORMAT, _VERSION)}")
    try:
        presses = [
            PressKey(int(location), str(name), int(target), require_role(role))
            for role, indenters in document["presses"].items()
            for name, listed in indenters.items()
            for target, location in listed
        ]
        split = Split(
            tuple(sorted(presses, key=lambda press: press.location)),
            tuple(map(str, document["held_out_sensors"])),
            float(document["validation"]),
            float(document["new_press"]),
            int(document["seed"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = f"missing {error}" if isinstance(error, KeyError) else error
        raise LearningError(f"{path}: corrupt or incomplete split: {problem}") from error
    if len({press.location for press in presses}) != len(presses):
        raise LearningError(f"{path}: found a location twice; allowed: one role each")
    return split


def presses_of(archive: MarkerArchive) -> dict[int, tuple[str, int]]:
    """Return indenter and target of each location in an archive."""
    presses: dict[int, tuple[str, int]] = {}
    for name, sensor in archive.items():
        columns = [sensor.table[key] for key in ("location", "indenter", "target")]
        for location, code, target in np.unique(np.stack(columns, 1), axis=0).tolist():
            press = (archive.indenters[code], target)
            if location >= 0 and presses.setdefault(location, press) != press:
                raise LearningError(
                    f"{archive.name}/{name}: found location {location} to be {press}, elsewhere "
                    f"{presses[location]}; allowed: the same press in all sensors"
                )
    if not presses:
        raise LearningError(f"{archive.name}: found no frame with a location; allowed: some")
    return presses


def require_role(role: str) -> Role:
    """Return a role; reject an unknown one."""
    if role not in ROLES:
        raise LearningError(f"role: found {role!r}; allowed: {', '.join(ROLES)}")
    return role


def _shuffled(presses: Iterable[tuple[str, int]], seed: int) -> list[tuple[str, int]]:
    """Order presses so that the first ones, however many, are spread over the indenters."""
    by_indenter: dict[str, list[int]] = {}
    for indenter, target in sorted(presses):
        by_indenter.setdefault(indenter, []).append(target)
    turns = []
    for indenter, targets in by_indenter.items():
        chance = generator(seed, "split", indenter)
        order = chance.permutation(len(targets))
        first = chance.random()
        turns += [
            ((turn + first) / len(targets), indenter, targets[index])
            for turn, index in enumerate(order)
        ]
    return [(indenter, target) for _, indenter, target in sorted(turns)]


def _require_among(what: str, names: Sequence[str], choices: Iterable[str]) -> None:
    allowed = list(choices)
    if unknown := sorted(set(names) - set(allowed)):
        raise LearningError(f"{what}: found {', '.join(unknown)}; allowed: {', '.join(allowed)}")
