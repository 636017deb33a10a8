"""What is shown of a session of force-depth presses once it is recorded."""

from __future__ import annotations

from pathlib import Path

from recorder import Session, SessionError
from recorder.session import press_curves, save_curves


def show_curve(path: Path) -> None:
    """Print the table of a session of presses and write its curve beside it."""
    try:
        session = Session(path)
        curves = press_curves(session)
    except SessionError as error:
        print(f"no curve: {error}")
        return
    print("\n".join(curves.lines()))
    picture = path.with_suffix(".curve.png")
    try:
        save_curves(curves, picture, f"{session.attrs['sensor']}, {session.attrs['indenter']}")
    except OSError as error:
        print(f"no curve: {picture}: {error}")
    else:
        print(f"force-depth curve: {picture}")
