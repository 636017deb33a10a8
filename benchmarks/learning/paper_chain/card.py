"""Card of a net of the paper's chain: data, split, seed, errors with intervals, licence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def card(
    row: Mapping[str, str],
    *,
    millions: float,
    archive: str,
    frames: int,
    trained: Sequence[str],
    tested: Sequence[str],
    seconds: float,
) -> str:
    """Return the card of a net that learned from a sensor's own labels.

    Args:
        row: Its row of the table of forces.
        millions: Its weights, in millions.
        archive: Options of `tactile sim archive` that make its frames.
        frames: Number of frames that it was trained on.
        trained: Indenters of these.
        tested: Indenters of the test.
        seconds: Time of the training [s].
    """
    sensor, preset = row["target"], row["net"]
    read = "marker displacement" if preset == "displacement" else "marker images"

    def known(name: str) -> str:
        return f"{row[name]} ({row[f'{name}_low']} to {row[f'{name}_high']})"

    def error(axis: str) -> str:
        return (
            f"{row[f'mae_{axis}_n']} N ({row[f'mae_{axis}_low_n']} to {row[f'mae_{axis}_high_n']})"
        )

    axes = ", ".join(f"{axis} {row[f'r2_{axis.lower()}']}" for axis in ("Fx", "Fy", "Fz"))
    lines = (
        f"# {sensor}-{preset}",
        "",
        f"Fx, Fy, Fz of the simulated sensor `{sensor}` from {read}; preset `{preset}`, "
        f"{millions:.2f} M weights; learned in simulation, not for measurements.",
        "",
        f"- **Data:** {frames} frames of `tactile sim archive {archive}`.",
        f"- **Split:** trained on {', '.join(trained)}; tested on {', '.join(tested)}.",
        f"- **Training:** {seconds:g} s on the sensor's own labels. Seed {row['seed']}, one run.",
        f"- **Error on the test indenters**, with 90 % intervals over them: R2 {known('r2')} "
        f"({axes}), mean absolute error of shear {error('shear')}, of Fz {error('fz')}; "
        f"{row['frames']} frames.",
        "- **Real sensors:** none was seen. Forces on one are wrong by an unknown factor.",
        "- **Licence:** Apache-2.0.",
    )
    return "\n".join(lines) + "\n"
