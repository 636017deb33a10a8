"""Tables and charts of the chain, from its CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.learning.paper_chain.sizes import ALONE, Size
from learning.evaluation.translation import NEAREST
from recorder.charts import chart
from recorder.store.files import replace_file

Row = dict[str, str]
# Rows of the table of forces, in its order.
METHODS = ("source-only", NEAREST, "displacement", "field", "m2m", "own labels", ALONE)
# Most pairs of sensors and translators in the picture of the worst frames.
WORST = 6


def write(out: Path, size: Size) -> None:
    """Write tables.md and the charts of the rows that there are."""
    forces, images, patterns = (_read(out, name) for name in ("forces", "images", "patterns"))
    (forces, new_forces), (images, new_images) = (
        _parted(rows, ("target",), size.held_out) for rows in (forces, images)
    )
    known, new = _parted(patterns, ("source", "target"), size.held_out_patterns)
    held_out = f"; held out: {', '.join(size.held_out)}"
    parts = [
        _table("Forces on unseen indenters, means over pairs", _of_forces(forces, size)),
        _table(f"The same{held_out}", _of_forces(new_forces, size)),
        _table("Images of unseen indenters, means over pairs", _of_images(images)),
        _table(f"The same{held_out}", _of_images(new_images)),
        _table("Force nets on their own labels", _of_nets(forces, _read(out, "latency"))),
        _table("Patterns, means over pairs", _of_patterns(known)),
        _table("The same; a pattern of the two is held out", _of_patterns(new)),
        _table("Trainings", [list(row.values()) for row in _with_head(_read(out, "trainings"))]),
    ]
    replace_file(out / "tables.md", "\n".join(parts).encode())
    if forces:
        _draw_forces(forces, size, out / "forces.png")
    if latency := _read(out, "latency"):
        _draw_nets(forces, latency, out / "nets.png")
    if patterns:
        _draw_patterns(patterns, out / "patterns.png")
    if (out / "patterns.npz").exists():
        _draw_embedded(out / "patterns.npz", out / "patterns-tsne.png")
    if (out / "worst").is_dir():
        _draw_worst(sorted((out / "worst").glob("*.npz")), out / "worst.png")


def last_line(out: Path, size: Size) -> str:
    """Return the line with the mean R2 of the chain, the nearest frame and the displacement.

    Sensors that were held out are not in the means.
    """
    forces, _ = _parted(_read(out, "forces"), ("target",), size.held_out)

    def r2(method: str) -> str:
        found = [float(row["r2"]) for row in forces if row["method"] == method]
        return f"{np.mean(found):.3f}" if found else "-"

    three = ("m2m", "paper chain"), (NEAREST, "nearest frame"), ("displacement", "displacement")
    return "  ".join(f"{name} R2 {r2(method)}" for method, name in three)


def _read(out: Path, name: str) -> list[Row]:
    path = out / f"{name}.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _parted(
    rows: Sequence[Row], keys: Sequence[str], held_out: Sequence[str]
) -> tuple[list[Row], list[Row]]:
    """Return the rows of known sensors or patterns, and those with one that was held out."""
    new = [any(row[key] in held_out for key in keys) for row in rows]
    return (
        [row for row, out in zip(rows, new, strict=True) if not out],
        [row for row, out in zip(rows, new, strict=True) if out],
    )


def _table(title: str, lines: Sequence[Sequence[str]]) -> str:
    if len(lines) < 2:
        return ""
    head, *rows = lines
    marks = ["---"] * len(head)
    text = "\n".join(f"| {' | '.join(each)} |" for each in (head, marks, *rows))
    return f"## {title}\n\n{text}\n"


def _with_head(rows: Sequence[Row]) -> list[Row]:
    return [{key: key for key in rows[0]}, *rows] if rows else []


def _mean(rows: Iterable[Row], key: str, digits: int = 3) -> str:
    found = [float(row[key]) for row in rows]
    return f"{np.mean(found):.{digits}f}" if found else "-"


def _of_forces(rows: Sequence[Row], size: Size) -> list[list[str]]:
    head = ["method", "net", "pairs", "R2", "R2, 90 % interval", "worst pair", "MAE shear, Fz [N]"]
    lines = [[*head, "better than source-only by R2, MAE of Fz"]]
    before = {(row["source"], row["target"]): row for row in rows if row["method"] == "source-only"}
    for method in METHODS:
        for net in dict.fromkeys(row["net"] for row in rows if row["method"] == method):
            own = [row for row in rows if (row["method"], row["net"]) == (method, net)]
            others = net not in (size.net, "displacement") and not size.memory
            if method == "own labels" and others:
                continue
            worst = min(own, key=lambda row: float(row["r2"]))
            pair = f"{float(worst['r2']):.3f} ({worst['source']} to {worst['target']})"
            interval = f"{_mean(own, 'r2_low')} to {_mean(own, 'r2_high')}"
            off = f"{_mean(own, 'mae_shear_n')}, {_mean(own, 'mae_fz_n')}"
            line = [method, net, str(len(own)), _mean(own, "r2"), interval, pair, off]
            lines.append([*line, _better(own, before)])
    return lines


def _better(rows: Sequence[Row], before: Mapping[tuple[str, str], Row]) -> str:
    """Return in how many pairs rows are better than those of the source's net as it is."""
    both = [
        (row, other)
        for row in rows
        if (other := before.get((row["source"], row["target"]))) is not None and row is not other
    ]
    by_r2 = sum(float(one["r2"]) > float(other["r2"]) for one, other in both)
    by_mae = sum(float(one["mae_fz_n"]) < float(other["mae_fz_n"]) for one, other in both)
    return f"{by_r2}, {by_mae} of {len(both)}" if both else "-"


def _of_images(rows: Sequence[Row]) -> list[list[str]]:
    keys = ("dice", "centroid_px", "centroid_p95_px", "count_mismatch", "ssim", "frechet", "kernel")
    lines = [["frames", "pairs", *keys]]
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        lines.append([method, str(len(own)), *(_mean(own, key) for key in keys)])
    return lines


def _of_nets(forces: Sequence[Row], latency: Sequence[Row]) -> list[list[str]]:
    lines = [["net", "weights", "R2", "R2, 90 % interval", "MAE shear, Fz [N]", "ms a frame"]]
    own = [row for row in forces if row["method"] == "own labels"]
    for net in dict.fromkeys(row["net"] for row in own):
        rows = [row for row in own if row["net"] == net]
        times = [row for row in latency if row["net"] == net]
        taken = ", ".join(
            f"{float(row['p50_ms']):.3g} ({row['runtime']}, {row['on']})"
            for row in times
            if row["p50_ms"]
        )
        interval = f"{_mean(rows, 'r2_low')} to {_mean(rows, 'r2_high')}"
        off = f"{_mean(rows, 'mae_shear_n')}, {_mean(rows, 'mae_fz_n')}"
        weights = times[0]["weights"] if times else "-"
        lines.append([net, weights, _mean(rows, "r2"), interval, off, taken or "-"])
    return lines


def _of_patterns(rows: Sequence[Row]) -> list[list[str]]:
    lines = [["pairs", "", "Dice", "Frechet", "kernel"]]
    for when in ("before", "after"):
        values = [_mean(rows, f"{key}_{when}") for key in ("dice", "frechet", "kernel")]
        lines.append([str(len(rows)), when, *values])
    return lines if rows else []


def _draw_forces(rows: Sequence[Row], size: Size, path: Path) -> None:
    nets = size.nets if size.memory else ("-", "displacement", size.net)
    methods = [name for name in METHODS if any(row["method"] == name for row in rows)]
    with chart(path, 8, 3.4) as figure:
        axes = figure.subplots()
        for place, method in enumerate(methods):
            own = [row for row in rows if row["method"] == method and row["net"] in nets]
            if method == "own labels" and not size.memory:
                own = [row for row in own if row["net"] == size.net]
            apart = min(0.1, 0.8 / max(1, len(own)))
            for shift, row in enumerate(own):
                at = place + apart * (shift - (len(own) - 1) / 2)
                low, r2, high = (max(-1.5, float(row[f"r2{end}"])) for end in ("_low", "", "_high"))
                axes.plot([at, at], [low, high], color=f"C{place}", linewidth=1)
                axes.plot(at, r2, "o", color=f"C{place}", markersize=4)
        axes.set_xticks(range(len(methods)), methods)
        axes.axhline(0, color="0.7", linewidth=0.8)
        axes.set_ylabel("R2 on unseen indenters, by pair")


def _draw_nets(forces: Sequence[Row], latency: Sequence[Row], path: Path) -> None:
    with chart(path, 6, 3.6) as figure:
        axes = figure.subplots()
        nets = list(dict.fromkeys(row["net"] for row in latency))
        for place, net in enumerate(nets):
            own = [row for row in forces if (row["method"], row["net"]) == ("own labels", net)]
            if not own:
                continue
            low, r2, high = (
                np.mean([float(row[f"r2{end}"]) for row in own]) for end in ("_low", "", "_high")
            )
            for row in latency:
                if row["net"] == net and row["p50_ms"]:
                    time = float(row["p50_ms"])
                    mark = "o" if row["runtime"] == "torch" else "s"
                    axes.plot([time, time], [low, high], color=f"C{place}", linewidth=1)
                    axes.plot(time, r2, mark, color=f"C{place}")
        named = [axes.plot([], [], "o", color=f"C{place}")[0] for place in range(len(nets))]
        kinds = list(dict.fromkeys((row["runtime"], row["on"]) for row in latency))
        named += [
            axes.plot([], [], "o" if kind[0] == "torch" else "s", color="0.5")[0] for kind in kinds
        ]
        figure.legend(named, [*nets, *map(", ".join, kinds)], loc="outside right upper")
        axes.set(xscale="log", xlabel="time of a frame, median [ms]", ylabel="R2, unseen indenters")


def _draw_patterns(rows: Sequence[Row], path: Path) -> None:
    names = list(dict.fromkeys(row[end] for row in rows for end in ("source", "target")))
    with chart(path, 9, 3.6) as figure:
        every = figure.subplots(1, 2)
        for axes, when in zip(every, ("before", "after"), strict=True):
            values = np.full((len(names), len(names)), np.nan)
            for row in rows:
                place = names.index(row["source"]), names.index(row["target"])
                values[place] = float(row[f"dice_{when}"])
            shown = axes.imshow(values, vmin=0, vmax=1)
            axes.set_xticks(range(len(names)), names, rotation=90, fontsize=6)
            axes.set_yticks(range(len(names)), names, fontsize=6)
            axes.set(title=f"Dice, {when}", xlabel="target", ylabel="source")
        figure.colorbar(shown, ax=list(every))


def _draw_embedded(stored: Path, path: Path) -> None:
    from matplotlib import colormaps

    from learning.evaluation.distribution import embedded

    with np.load(stored) as found:
        features = {name: found[name] for name in found.files}
    places = embedded(np.concatenate([*features.values()]), seed=0)
    ends = np.cumsum([len(each) for each in features.values()])
    with chart(path, 6, 4.2) as figure:
        axes = figure.subplots()
        real = [name for name in features if " to " not in name]
        for name, part in zip(features, np.split(places, ends[:-1]), strict=True):
            target = name.split(" to ")[-1]
            mark, label = ("x", None) if " to " in name else ("o", name)
            # A colour of a palette of 20 for each pattern.
            colour = colormaps["tab20"](real.index(target))
            axes.plot(*part.T, mark, color=colour, markersize=3, label=label)
        axes.set(xticks=[], yticks=[], title="t-SNE: o real, x translated from the first pattern")
        figure.legend(loc="outside right upper", fontsize=7)


def _draw_worst(stored: Sequence[Path], path: Path) -> None:
    """Draw the two worst frames of the pairs whose worst frame is worst."""
    found = []
    for file in stored:
        with np.load(file) as one:
            found.append((file.stem, one["frames"], one["dice"]))
    found = sorted(found, key=lambda each: float(each[2].min()))[:WORST]
    with chart(path, 6.5, 1.5 * len(found)) as figure:
        every = figure.subplots(len(found), 6, squeeze=False)
        for line, (pair, frames, dice) in zip(every, found, strict=True):
            for axes in line:
                axes.set_axis_off()
            for number in range(frames.shape[1]):
                for part, name in enumerate(("source", "translated", "real")):
                    axes = line[3 * number + part]
                    axes.imshow(frames[part, number], cmap="gray", vmin=0, vmax=255)
                    score = f" {dice[number]:.2f}" if name == "translated" else ""
                    above = f"{pair}\n" if (number, part) == (0, 0) else ""
                    axes.set_title(f"{above}{name}{score}", fontsize=6, loc="left")
