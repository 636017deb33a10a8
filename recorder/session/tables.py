"""Frames of a session as a table of pandas or a data set of xarray."""

from importlib import import_module
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.session.reader import Session
from recorder.store.documents import read_document

# Names of the components of a row, by kind of stream.
_COMPONENTS = {
    "force": ("fx", "fy", "fz", "tx", "ty", "tz"),
    "arm_wrench": ("fx", "fy", "fz", "tx", "ty", "tz"),
    "pose": ("x", "y", "z", "rx", "ry", "rz"),
}


def to_pandas(session: Session) -> Any:
    """Return the frames as a DataFrame, one row per tick, with `t_ns` as index.

    Components of vectors have columns of their own, such as `wrench_fz`; images and texts have the
    number of their row in the stream. `attrs["units"]` has the unit of each column of `frames`.

    Raises:
        SessionError: pandas is not installed, the session has no frames yet, or data are corrupt.
    """
    pandas, frames = _library("pandas"), session.require_frames()
    components = _components(session)
    columns: dict[str, Any] = {}
    for name, values in frames.items():
        if values.ndim == 1:
            columns[name] = values
            continue
        flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
        numbers = ("_".join(map(str, index)) for index in np.ndindex(*values.shape[1:]))
        labels = components.get(name) or numbers
        columns |= {f"{name}_{label}": flat[:, k] for k, label in enumerate(labels)}
    table = pandas.DataFrame(columns).set_index("t_ns")
    table.attrs["units"] = {name: _about(session, name)["units"] for name in frames}
    return table


def to_xarray(session: Session) -> Any:
    """Return the frames as a Dataset along `t_ns`, with units and descriptions.

    Raises:
        SessionError: xarray is not installed, the session has no frames yet, or data are corrupt.
    """
    xarray, frames = _library("xarray"), session.require_frames()
    components = _components(session)
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {"t_ns": frames["t_ns"]}
    for name, values in frames.items():
        if name == "t_ns":
            continue
        further = [f"{name}_axis{'' if k == 1 else k}" for k in range(1, values.ndim)]
        variables[name] = (("t_ns", *further), values, _about(session, name))
        if name in components:
            coordinates[further[0]] = list(components[name])
    attributes = {key: session.attrs.get(key, "") for key in ("sensor", "indenter", "status")}
    return xarray.Dataset(variables, coordinates, {"name": session.name, **attributes})


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise SessionError(f"to_{name} needs {name}: pip install 'tactile-rig[tables]'") from error


def _about(session: Session, name: str) -> dict[str, str]:
    """Return units and description of a column of `frames`, as stored."""
    path = session.path / "frames" / name / "zarr.json"
    attributes = read_document(session.files, path).get("attributes", {})
    return {key: str(attributes.get(key, "")) for key in ("units", "description")}


def _components(session: Session) -> dict[str, tuple[str, ...]]:
    """Return the names of the components of each column of `frames` that has any."""
    components: dict[str, tuple[str, ...]] = {}
    for stream, column in session.columns.items():
        names = _COMPONENTS.get(session.streams[stream].traits.kind, ())
        value = session.streams[stream].value_column
        if value is not None and value.shape == (len(names),):
            components[column] = names
    return components
