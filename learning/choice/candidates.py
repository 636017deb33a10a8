"""Ways from a sensor's frames to its forces, from the simplest to the largest: one row each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from learning.config import settings_to_dict
from learning.data.presses import Form, Presses
from learning.force.closed_form import ClosedFormModel, Features, fit_closed_form
from learning.force.model import ForceModel
from learning.force.train import ForceModelSettings, read_force_settings, train_force
from recorder.archive import MASKS, ArchivedSensor

# Settings over those of the presets: no presses are kept back to end a training early.
OVER: tuple[str, ...] = ("patience_epochs=null",)
# Presses of the sensor by the form of their frames.
Frames = Mapping[Form, Presses]


@dataclass(frozen=True, slots=True)
class Candidate:
    """A way to forces that can be trained again without some indenters."""

    name: str
    about: str
    form: Form
    """Form of the frames that its models take."""
    features: Features | None = None
    """Features of a model in closed form."""
    preset: str | None = None
    """Preset of a network."""
    plugin: str | None = None
    """Another package's model, in place of the preset's network."""
    source: Callable[[], Presses] | None = None
    """Returns presses of another sensor that the network learns first, whose indenters have the
    codes of this one's (`with_codes`)."""
    tuned: bool = True
    """True if the network learns the sensor's own presses."""

    def train(self, presses: Presses, seed: int, without_codes: frozenset[int]) -> ForceModel:
        """Return the model of labelled presses without some indenters."""
        own = without(presses, without_codes)
        if self.features is not None:
            return fit_closed_form(own, self.features)
        settings = self._settings(seed, presses)
        if self.source is None:
            return train_force(own, settings)
        model = train_force(without(self.source(), without_codes), settings)
        if not self.tuned:
            return model
        stage = replace(settings.stages[-1], learning_rate=0.3 * settings.stages[-1].learning_rate)
        return train_force(own, replace(settings, stages=(stage,)), start_from=model)

    def settings(self, model: ForceModel, seed: int, presses: Presses) -> dict[str, Any]:
        """Return the settings of a trained model, as plain values of its folder."""
        if isinstance(model, ClosedFormModel):
            return {"closed_form": asdict(model.settings), "input": asdict(model.inputs)}
        return settings_to_dict(self._settings(seed, presses))

    def _settings(self, seed: int, presses: Presses) -> ForceModelSettings:
        device = f"launch.device={presses.device.type}"
        more = () if self.plugin is None else (f"plugin={self.plugin}",)
        return read_force_settings(str(self.preset), (f"seed={seed}", device, *OVER, *more))


def candidates_of(
    sensor: ArchivedSensor, other: str = "", source: Callable[[], Presses] | None = None
) -> tuple[Candidate, ...]:
    """Return the ways for a sensor, the simplest first.

    `source` returns labelled marker fields of a sensor `other`, with this one's indenter codes.
    """
    masks = sensor.representation == MASKS
    form: Form = "field" if masks else "shading"
    seen = "marker motion" if masks else "the picture's change"
    ways = [
        Candidate("mean", "the mean of the labels", form, "mean"),
        Candidate("ridge", f"ridge regression on 11 statistics of {seen}", form, "statistics"),
        Candidate("cells", f"ridge regression on {seen} in 8 x 8 cells", form, "grid"),
        Candidate("kernel", f"{seen} in cells, and likeness to learned frames", form, "kernel"),
    ]
    if not masks:
        return *ways, Candidate("net", f"a net on {seen}", form, preset="shading")
    net = Candidate("net", f"a net on {seen}", form, preset="displacement")
    images = Candidate("images", "the paper's net, smaller, on images", "images", preset="tiny")
    if source is not None:
        about = f"a net on {seen} of {other}"
        first = replace(net, source=source)
        ways.append(replace(first, name="source", about=f"{about}, as it is", tuned=False))
        ways.append(replace(first, name="tuned", about=f"{about}, tuned on own labels"))
    return *ways, net, images


def of_plugin(name: str) -> Candidate:
    """Return the way by a force model that an installed package offers (`learning.plugins`)."""
    form = read_force_settings("tiny", (f"plugin={name}",)).input.stored_form
    return Candidate(name, "a model of another package", form, preset="tiny", plugin=name)


def with_codes(presses: Presses, names: Sequence[str], others: Sequence[str]) -> Presses:
    """Return presses whose indenters' codes, in `names`, become those in `others`.

    Indenters that are not among the others have negative codes.
    """
    place = {name: code for code, name in enumerate(others)}
    codes = [place.get(names[code], -1 - code) for code in presses.indenter.tolist()]
    return replace(presses, indenter=torch.tensor(codes, dtype=torch.int64))


def of_indenters(presses: Presses, indenters: frozenset[int]) -> Tensor:
    """Return True for presses (P,) of some indenters."""
    return torch.from_numpy(np.isin(presses.indenter.numpy(), sorted(indenters)))


def without(presses: Presses, indenters: frozenset[int]) -> Presses:
    """Return the presses that are not of some indenters."""
    return presses.only(~of_indenters(presses, indenters))
