"""Run command lines of a checkout, summarise their results, and compare them with a record.

Only argv and files are used: nothing of the packages is imported here.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from PIL import Image

HERE = Path(__file__).resolve().parent
DATA, EXPECTED = HERE / "data", HERE / "expected"
CHECKOUT = HERE.parent.parent

# Placeholders: a value that is not compared, one that may also be missing, a number in a text.
ANY, MAYBE, NUMBER = "<any>", "<maybe>", "<#>"

# Our own codecs: such arrays are compared by their stored bytes.
PRODUCT_CODECS = {"imagecodecs_jpeg"}
# JSON keys whose values are durations and are never compared.
TIMES = {"seconds", "seconds_by_stage", "cpu_seconds", "wall_s"}
# JSON keys and arrays with counts or residuals of iterations: their values are compared only on
# the same machine.
ITERATIONS = {"newton", "cg", "residual", "contact", "balance", "slip_excess"}
# Arrays with shares of a whole, computed as differences of nearly equal numbers: on another machine
# they may differ by the tolerance of the whole.
SHARES = {"energy_gap"}
# Largest number of files in a folder that are listed individually; more are hashed together.
MOST_NAMES = 60

# Lines of standard error that report progress, or come from libraries.
_NOISE = re.compile(
    r"^[\w -]+: (compiling kernels|[\d.]+ %|[\d.]+ s\b)|^\d[\d,]* of \d[\d,]* |left *$|^\d+/\d+ |"
    r"^\[ WARN|site-packages"
)
_DURATION = re.compile(r"(?<![\w.])\d[\d.,]* (s|ms|min|h|images/s|a second)(?![\w/])")
# Units of a masked duration, which a slower machine changes: 58 s, 1:02 min.
_UNIT = re.compile(r"<time> (?:s|min|h)(?![\w/])")
_CLOCK = re.compile(r"(?<![\w.:])(\d+|\?):(\d\d|\?\?)(:\d\d)?(?![\w:])")
_NUMBERS = re.compile(r"[-+]?\d[\d.,:]*(e[-+]?\d+)?")
_UTC = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+Z?")


@dataclass(frozen=True, slots=True)
class Case:
    """Some command lines and the outputs to compare.

    Attributes:
        name: Name of the case, and of its record.
        commands: `tactile ARGUMENTS`, one per line; `{out}` is an empty folder, `{data}` the folder
            of data, `{root}` the checkout. Each is a separate process.
        together: If true, one process runs all of them, to save the time of imports.
        prepare: Changes to files beforehand: `("copy", from, to)`, `("write", path, text)`,
            `("fill", path)` for names in braces within a file, `("npy", path, rows, columns,
            step)`, `("png", path, shade)`, `("delete", path)`, `("cut", path, bytes)`,
            `("json", path, "a.b.c", value)`.
        look: Globs of the files and folders in `{out}` to compare.
        loose: True if it runs in real time, so that only the structure of its output is stable.
        portable: True if hashes must be equal on every machine, because bytes are only moved.
        unstable: Regular expressions of dotted paths in the result that are not compared.
        rtol: Relative tolerance of numbers.
        rtol_elsewhere: The same on a machine other than that of the record.
        slow: True if it takes more than about ten seconds.
        timed: True if its output contains durations, which are removed.
        once: True if it is recorded in a single run, because it takes minutes.
        timeout: Timeout of a command [s].
    """

    name: str
    commands: tuple[str, ...]
    one_process: bool = False
    prepare: tuple[tuple[Any, ...], ...] = ()
    look: tuple[str, ...] = ()
    loose: bool = False
    portable: bool = False
    unstable: tuple[str, ...] = ()
    rtol: float = 1e-6
    rtol_elsewhere: float = 1e-3
    slow: bool = False
    timed: bool = True
    once: bool = False
    timeout: int = 300


# Running


def run_case(case: Case, root: Path) -> dict[str, Any]:
    """Run a case in a checkout and return its result."""
    out = Path(tempfile.mkdtemp(prefix="golden-")).resolve()
    places = {"out": str(out), "data": str(DATA), "root": str(root)}
    try:
        for step in case.prepare:
            _prepare(step, places)
        ran = (
            _run_in_one_process(case, root, places)
            if case.one_process
            else _run_each(case, root, places)
        )
        commands = [
            _told(case, line, *each, places) for line, each in zip(case.commands, ran, strict=True)
        ]
        found: dict[str, Any] = {"commands": commands}
        if case.look:
            found["files"] = {
                str(path.relative_to(out)): _look(path, case.loose)
                for pattern in case.look
                for path in sorted(out.glob(pattern))
            }
        return _plain(_without(_placed(found, places), case.unstable))
    finally:
        shutil.rmtree(out, ignore_errors=True)


def _run_each(case: Case, root: Path, places: dict[str, str]) -> list[tuple[int, str, str]]:
    ran = []
    for line in case.commands:
        package, *arguments = _words(line, places)
        done = _process([sys.executable, "-m", package, *arguments], case, root)
        ran.append((done.returncode, done.stdout, done.stderr))
    return ran


def _run_in_one_process(
    case: Case, root: Path, places: dict[str, str]
) -> list[tuple[int, str, str]]:
    lines = json.dumps([_words(line, places) for line in case.commands])
    done = _process([sys.executable, str(HERE / "one_process.py"), lines], case, root)
    if done.returncode:
        raise RuntimeError(f"{case.name}: {done.stderr[-2000:]}")
    return [(code, reported, erred) for code, reported, erred in json.loads(done.stdout)]


def _process(argv: list[str], case: Case, root: Path) -> subprocess.CompletedProcess[str]:
    env = {
        **os.environ,
        "PYTHONPATH": str(root),
        "COLUMNS": "100",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONHASHSEED": "0",
        "PYTHONWARNINGS": "ignore",
        "CUDA_VISIBLE_DEVICES": "",
    }
    return subprocess.run(
        argv,
        cwd=root,
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=case.timeout,
        check=False,
    )


def _words(line: str, places: dict[str, str]) -> list[str]:
    import shlex

    return [_filled(word, places) for word in shlex.split(line)]


def _filled(text: str, places: dict[str, str]) -> str:
    for name, place in places.items():
        text = text.replace("{" + name + "}", place)
    return text


def _prepare(step: tuple[Any, ...], places: dict[str, str]) -> None:
    kind, *rest = step
    given = [_filled(each, places) if isinstance(each, str) else each for each in rest]
    path = Path(given[0])
    if kind == "copy":
        copy = shutil.copytree if path.is_dir() else shutil.copyfile
        copy(path, given[1])
    elif kind == "write":
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(given[1])
    elif kind == "npy":
        np.save(path, np.arange(given[1] * given[2]).reshape(given[1], given[2]) * given[3])
    elif kind == "png":
        path.parent.mkdir(parents=True, exist_ok=True)
        shades = np.arange(48 * 64, dtype=np.uint32).reshape(48, 64, 1) * (1, 2, 3) + given[1]
        Image.fromarray((shades % 256).astype(np.uint8)).save(path)
    elif kind == "fill":
        path.write_text(_filled(path.read_text(), places))
    elif kind == "delete":
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    elif kind == "cut":
        path.write_bytes(path.read_bytes()[: given[1]])
    elif kind == "json":
        document = json.loads(path.read_text())
        inner, *keys = document, *given[1].split(".")
        for key in keys[:-1]:
            inner = inner[int(key) if isinstance(inner, list) else key]
        if given[2] is None:
            inner.pop(keys[-1])
        else:
            inner[keys[-1]] = given[2]
        path.write_text(json.dumps(document))
    else:
        raise ValueError(f"{kind}: no such step")


# Output of a command


def _told(
    case: Case, line: str, code: int, reported: str, erred: str, places: dict[str, str]
) -> dict[str, Any]:
    found: dict[str, Any] = {"argv": line, "exit": code}
    if reported.lstrip().startswith("{"):
        found["json"] = json.loads(reported)
    else:
        text = _lines(reported, places, timed=case.timed)
        if case.loose:
            text = [_NUMBERS.sub(NUMBER, each) for each in (text[:1] + text[1:][-1:])]
        found["text"] = text
    errors = _lines(erred, places, timed=False)
    if code == 0:
        errors = [each for each in errors if each.startswith(("note", "warning", "error"))]
    elif "Traceback (most recent call last):" in errors:
        errors = errors[-1:]
    elif any(each.startswith("usage:") for each in errors):
        errors = [each for each in errors if ": error: " in each]
    if case.loose:
        errors = [] if code == 0 else [_NUMBERS.sub(NUMBER, each) for each in errors[-1:]]
    if errors:
        found["errors"] = errors
    return found


def _lines(reported: str, places: dict[str, str], *, timed: bool = True) -> list[str]:
    """Return the lines with paths and times masked.

    If `timed`, durations are masked. Otherwise (errors) they stay, and progress is removed.
    """
    found = []
    for line in reported.splitlines():
        line = line.rpartition("\r")[2]
        if not timed and _NOISE.search(line):
            continue
        line = _UTC.sub("<utc>", _place(line, places))
        if timed:
            line = _DURATION.sub(r"<time> \1", _CLOCK.sub("<time>", line))
            line = _UNIT.sub("<time>", line)
        if line.startswith("<time> ("):
            line = _NUMBERS.sub(NUMBER, line)
        if line := " ".join(line.split()):
            found.append(line)
    return found


def _place(text: str, places: dict[str, str]) -> str:
    for name in ("out", "data", "root"):
        text = text.replace(places[name], "{" + name + "}")
    return text


def _placed(found: Any, places: dict[str, str]) -> Any:
    if isinstance(found, dict):
        return {_place(key, places): _placed(value, places) for key, value in found.items()}
    if isinstance(found, list | tuple):
        return [_placed(value, places) for value in found]
    return _place(found, places) if isinstance(found, str) else found


def _without(found: dict[str, Any], unstable: Iterable[str]) -> dict[str, Any]:
    patterns = [re.compile(each) for each in unstable]

    def walk(value: Any, where: str) -> Any:
        if any(each.fullmatch(where) for each in patterns):
            return ANY
        if isinstance(value, dict):
            return {
                key: ANY if key in TIMES else walk(inner, f"{where}.{key}".lstrip("."))
                for key, inner in value.items()
            }
        if isinstance(value, list):
            return [walk(inner, f"{where}.{index}") for index, inner in enumerate(value)]
        return value

    kept: dict[str, Any] = walk(found, "")
    return kept


def _plain(value: Any) -> Any:
    """Convert to JSON values, with floats rounded to 9 digits."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else str(value)
    return value


# Content of files


def _look(path: Path, loose: bool) -> Any:
    if path.is_dir():
        if (path / "zarr.json").exists():
            return _look_zarr(path, loose)
        files = sorted(each for each in path.rglob("*") if each.is_file())
        zarrs = sorted(each.parent for each in files if each.name == "zarr.json")
        tops = [each for each in zarrs if not any(up in zarrs for up in each.parents)]
        files = [each for each in files if not any(top in each.parents for top in tops)]
        if len(files) > MOST_NAMES:
            listed = "".join(
                f"{each.relative_to(path)} {_sha(each.read_bytes())}\n" for each in files
            )
            names = "".join(f"{each.relative_to(path)}\n" for each in files)
            return {
                "count": len(files),
                "names": _sha(names.encode()),
                "sha256": _sha(listed.encode()),
                **{str(each.relative_to(path)): _look(each, loose) for each in tops},
            }
        return {str(each.relative_to(path)): _look(each, loose) for each in [*files, *tops]}
    if loose and path.suffix == ".csv":
        return {"head": _look_table(path)["head"]}
    look = _LOOKS.get(path.suffix)
    if look is None or loose:
        return {"sha256": _sha(path.read_bytes())} if not loose else {"is": "there"}
    return look(path)


def _sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _array(values: Any) -> dict[str, Any]:
    """Return shape, hash, and a few numbers of an array."""
    values = np.asarray(values)
    found: dict[str, Any] = {"shape": list(values.shape), "dtype": str(values.dtype)}
    if values.dtype.kind in "fc":
        wide = values.astype(np.complex128 if values.dtype.kind == "c" else np.float64)
        finite = np.isfinite(wide)
        found["norm"] = float(np.linalg.norm(wide[finite]))
        if not finite.all():
            found["finite"] = int(finite.sum())
        flat = wide.ravel().real
        found["sample"] = [float(each) for each in flat[:: max(1, flat.size // 5)][:6]]
    elif values.dtype.kind in "iub":
        found["sum"] = int(values.astype(object).sum()) if values.size else 0
        found |= {"least": int(values.min()), "most": int(values.max())} if values.size else {}
    if values.dtype.kind == "O" or values.dtype.kind == "T":
        found["sha256"] = _sha("\n".join(map(str, values.ravel())).encode())
    else:
        found["sha256"] = _sha(np.ascontiguousarray(values).tobytes())
    return found


def _look_zarr(path: Path, loose: bool) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for document in sorted(path.rglob("zarr.json")):
        node, content = document.parent, json.loads(document.read_text())
        attrs = content.get("attributes", {})
        name = str(node.relative_to(path))
        if content["node_type"] == "group":
            # The digests in a manifest follow from files that are compared themselves.
            only_keys = loose or name.startswith("manifest/")
            found[name] = {"keys": sorted(attrs)} if only_keys else {"attrs": attrs}
            continue
        codecs = _codecs(content["codecs"])
        one: dict[str, Any] = {
            "dims": content.get("dimension_names"),
            "codecs": codecs,
            "attrs": {key: attrs[key] for key in ("units", "description") if key in attrs}
            if loose
            else attrs,
        }
        if loose:
            dtype = content["data_type"]
            one |= {"dtype": dtype, "shape": [ANY, *content["shape"][1:]]}
        elif PRODUCT_CODECS & set(codecs):
            one |= {"dtype": content["data_type"], "shape": content["shape"]}
            chunks = sorted(each for each in node.rglob("*") if each.is_file() and each != document)
            listed = "".join(
                f"{each.relative_to(node)} {_sha(each.read_bytes())}\n" for each in chunks
            )
            one["sha256"] = _sha(listed.encode())
        else:
            one |= _array(zarr.open_array(str(node), mode="r")[...])
        found[name] = one
    return found


def _codecs(listed: list[dict[str, Any]]) -> list[str]:
    names = []
    for each in listed:
        names.append(each["name"])
        names += _codecs(each.get("configuration", {}).get("codecs", []))
    return names


def _look_onnx(path: Path) -> Any:
    """Return the graph and its weights, without the names of the traced Python modules."""
    import onnx

    model = onnx.load(str(path))
    del model.metadata_props[:], model.graph.metadata_props[:]
    nodes = list(model.graph.node)
    nodes += [each for function in model.functions for each in function.node]
    for part in [*nodes, *model.graph.value_info, *model.graph.initializer]:
        del part.metadata_props[:]
        part.doc_string = ""
    model.graph.doc_string = ""
    return {"nodes": len(nodes), "sha256": _sha(model.SerializeToString(deterministic=True))}


def _look_json(path: Path) -> Any:
    return json.loads(path.read_text())


def _look_text(path: Path) -> dict[str, Any]:
    text = path.read_text(errors="replace")
    return {"lines": len(text.splitlines()), "sha256": _sha(text.encode())}


def _look_table(path: Path) -> dict[str, Any]:
    lines = path.read_text(errors="replace").splitlines()
    rows = [[_number(cell) for cell in line.split(",")] for line in lines]
    return {"head": rows[:1], "count": len(rows), "rows": rows[1:13]}


def _number(cell: str) -> Any:
    try:
        return float(cell)
    except ValueError:
        return cell


def _look_picture(path: Path) -> dict[str, Any]:
    with Image.open(path) as picture:
        return {"size": list(picture.size), "sha256": _sha(picture.convert("RGB").tobytes())}


def _look_npz(path: Path) -> dict[str, Any]:
    with np.load(path) as arrays:
        return {name: _array(arrays[name]) for name in sorted(arrays)}


def _look_tensors(path: Path) -> dict[str, Any]:
    content = path.read_bytes()
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    kinds = {"F64": "f8", "F32": "f4", "F16": "f2", "I64": "i8", "I32": "i4", "U8": "u1"}
    norm, count = 0.0, 0
    names, digest = [], hashlib.sha256()
    for name, entry in sorted(header.items()):
        if name == "__metadata__":
            continue
        begin, end = (8 + length + offset for offset in entry["data_offsets"])
        digest.update(f"{name} {entry['dtype']} {entry['shape']}\n".encode())
        digest.update(content[begin:end])
        names.append(f"{name} {entry['shape']}")
        values = np.frombuffer(content[begin:end], kinds.get(entry["dtype"], "u1"))
        count += values.size
        norm += float((values.astype(np.float64) ** 2).sum())
    return {
        "tensors": len(names),
        "numbers": count,
        "names": _sha("\n".join(names).encode()),
        "norm": math.sqrt(norm),
        "sha256": digest.hexdigest(),
    }


def _look_h5(path: Path) -> dict[str, Any]:
    import h5py

    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        attrs = sorted(item.attrs)
        if isinstance(item, h5py.Dataset):
            if item.dtype.kind == "O":
                rows = [bytes(np.asarray(row).tobytes()) for row in item[...].ravel()]
                found[name] = {"shape": list(item.shape), "sha256": _sha(b"".join(rows))}
            else:
                found[name] = _array(item[...])
            found[name]["keys"] = attrs
        else:
            found[name] = {"keys": attrs}

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return found


def _look_parquet(path: Path) -> dict[str, Any]:
    from pyarrow import parquet

    table = parquet.read_table(path)
    rows = json.dumps(table.to_pylist(), default=str, sort_keys=True)
    return {"columns": table.column_names, "rows": table.num_rows, "sha256": _sha(rows.encode())}


def _look_mcap(path: Path) -> dict[str, Any]:
    from mcap.reader import make_reader

    counts: dict[str, int] = {}
    digest = hashlib.sha256()
    for _, channel, message in make_reader(io.BytesIO(path.read_bytes())).iter_messages():
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
        digest.update(f"{channel.topic} {message.log_time}\n".encode() + message.data)
    return {"messages": counts, "sha256": digest.hexdigest()}


_LOOKS = {
    ".onnx": _look_onnx,
    ".json": _look_json,
    ".md": _look_text,
    ".html": _look_text,
    ".csv": _look_table,
    ".png": _look_picture,
    ".jpg": _look_picture,
    ".npz": _look_npz,
    ".npy": lambda path: _array(np.load(path)),
    ".safetensors": _look_tensors,
    ".h5": _look_h5,
    ".hdf5": _look_h5,
    ".parquet": _look_parquet,
    ".mcap": _look_mcap,
}


# Comparison of two results, and of a result with its record


def agreed(one: Any, other: Any, where: str = "", dropped: list[str] | None = None) -> Any:
    """Return the common part of two runs; paths of differences are appended to `dropped`."""
    dropped = [] if dropped is None else dropped
    if isinstance(one, dict) and isinstance(other, dict):
        kept = {}
        for key in sorted({*one, *other}):
            inside = f"{where}.{key}".lstrip(".")
            if key in one and key in other:
                kept[key] = agreed(one[key], other[key], inside, dropped)
            else:
                dropped.append(f"{inside}: in one run only")
                kept[key] = MAYBE
        return kept
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            agreed(left, right, f"{where}.{index}", dropped)
            for index, (left, right) in enumerate(zip(one, other, strict=True))
        ]
    if one == other and type(one) is type(other):
        return one
    dropped.append(f"{where}: {str(one)[:60]} | {str(other)[:60]}")
    if isinstance(one, str) and isinstance(other, str) and " " in one:
        masked = [_NUMBERS.sub(NUMBER, each) for each in (one, other)]
        if masked[0] == masked[1]:
            return masked[0]
    return ANY


def _root_mean_square(array: dict[str, Any]) -> float:
    return float(array["norm"] / math.sqrt(max(math.prod(array["shape"]), 1)))


def differences(
    expected: Any,
    found: Any,
    case: Case,
    *,
    same_machine: bool,
    where: str = "",
    scale: float = 1e-3,
) -> list[str]:
    """Return lines on differences; hashes of computed numbers count only on the same machine.

    Numbers of a list may differ by the tolerance of the list's largest, `scale`; a sample of an
    array, on another machine, by that of the array's root mean square if it is more.
    """
    if expected in (ANY, MAYBE) if isinstance(expected, str) else False:
        return []
    key = where.rpartition(".")[2]
    inner = {"case": case, "same_machine": same_machine}
    if isinstance(expected, dict) and isinstance(found, dict):
        lines = []
        for name in sorted({*expected, *found}):
            inside = f"{where}.{name}".lstrip(".")
            if name not in found:
                if expected[name] != MAYBE:
                    lines.append(f"{inside}: missing, was {_short(expected[name])}")
            elif name not in expected:
                lines.append(f"{inside}: new, {_short(found[name])}")
            elif not same_machine and not case.portable and name in {"sha256", *ITERATIONS}:
                continue
            else:
                of_array = name == "sample" and not same_machine and "norm" in expected
                size = {"scale": _root_mean_square(expected)} if of_array else {}
                lines += differences(expected[name], found[name], where=inside, **inner, **size)
        return lines
    if isinstance(expected, list) and isinstance(found, list):
        if len(expected) != len(found):
            return [f"{where}: {len(expected)} became {len(found)}", *_listed(expected, found)]
        scale = max(scale, _largest(expected))
        return [
            line
            for index, (left, right) in enumerate(zip(expected, found, strict=True))
            for line in differences(left, right, where=f"{where}.{index}", scale=scale, **inner)
        ]
    if _is_number(expected) and _is_number(found):
        unsure = key in {"sum", "least", "most"} or ITERATIONS & {*re.split(r"[./]", where)}
        if unsure and not same_machine and not case.portable:
            return []
        rtol = case.rtol if same_machine or case.portable else case.rtol_elsewhere
        if not same_machine and SHARES & {*re.split(r"[./]", where)}:
            scale = 1.0
        if type(expected) is int and type(found) is int and (same_machine or case.portable):
            close = expected == found
        else:
            close = math.isclose(expected, found, rel_tol=rtol, abs_tol=scale * rtol)
        return [] if close else [f"{where}: {expected!r} became {found!r}"]
    if isinstance(expected, str) and isinstance(found, str) and NUMBER in expected:
        pattern = re.escape(expected).replace(re.escape(NUMBER), r"[-+]?\S+")
        close = bool(re.fullmatch(pattern, found))
        return [] if close else [f"{where}: {_short(expected)} became {_short(found)}"]
    if expected == found and type(expected) is type(found):
        return []
    if not same_machine and not case.portable and isinstance(expected, str):
        masked = [_NUMBERS.sub(NUMBER, str(each)) for each in (expected, found)]
        if masked[0] == masked[1]:
            return []
    return [f"{where}: {_short(expected)} became {_short(found)}"]


def _largest(values: list[Any]) -> float:
    """Return the largest number of a list, including nested lists; 0 if there is none."""
    inner = (_largest(each) if isinstance(each, list) else each for each in values)
    return max((abs(each) for each in inner if _is_number(each)), default=0.0)


def _listed(expected: list[Any], found: list[Any]) -> list[str]:
    gone = [each for each in expected if each not in found]
    new = [each for each in found if each not in expected]
    return [f"  - {_short(each)}" for each in gone[:8]] + [
        f"  + {_short(each)}" for each in new[:8]
    ]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    text = json.dumps(value) if not isinstance(value, str) else value
    return text if len(text) <= 160 else text[:157] + "..."


# Records


def machine() -> str:
    """Describe everything that the last digits of numbers depend on."""
    words, flags = "", ""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        name, _, value = (part.strip() for part in line.partition(":"))
        if name in ("model name", "cpu family", "model") and not flags:
            words += f" {value}"
        if name == "flags":
            flags = " ".join(sorted(value.split()))
    versions = []
    for name in ("numpy", "scipy", "torch", "warp-lang", "opencv-contrib-python-headless"):
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            versions.append(f"{name} none")
    major, minor = sys.version_info[:2]
    return f"cpu{words} {_sha(flags.encode())[:8]}, python {major}.{minor}, {', '.join(versions)}"


def as_text(record: dict[str, Any]) -> str:
    """Return a record as JSON: sorted, lists of plain values on one line."""
    text = json.dumps(record, indent=1, sort_keys=True, ensure_ascii=False)
    flat = re.compile(r"\[\n\s*([^\[\]{}\"]*?)\n\s*\]")
    text = flat.sub(lambda found: "[" + " ".join(found.group(1).split()) + "]", text)
    return text + "\n"


def record_path(case: Case) -> Path:
    """Return the path of a case's record."""
    return EXPECTED / f"{case.name}.json"


def compare(case: Case, found: dict[str, Any]) -> tuple[list[str], bool]:
    """Return lines on differences from the record, and True if hashes were compared."""
    path = record_path(case)
    if not path.exists():
        return [f"{path.name}: no record; make one with record.py"], False
    record = json.loads(path.read_text())
    same = record["machine"] == machine()
    hashed = same or case.portable
    expected = record["found"]
    return differences(expected, found, case, same_machine=same), hashed
