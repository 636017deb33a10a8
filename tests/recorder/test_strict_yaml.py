"""Strict YAML: written values are read back unchanged, and nothing is overwritten silently."""

from pathlib import Path

import pytest

from recorder.settings import Reader, merged, yaml_text

READER = Reader(ValueError)


@pytest.mark.parametrize(
    "value",
    ["2902e78", "1e5", "-3E+2", "no", "true", "1e-4x", "0x10", "089", "0o7", "1:30", 1e-5, 3],
)
def test_what_is_written_is_read_back_as_it_was(tmp_path: Path, value: object) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(yaml_text({"code_version": value, "rates": [value]}))
    assert READER.read(path) == {"code_version": value, "rates": [value]}


def test_plain_words_are_those_of_yaml_1_2() -> None:
    written = "1e-4 2E3 no on yes True 1.5 -1 040 0o40 0x1F 08.5 1:30 1_000 2026-01-31 0b1 = <<"
    as_1_2 = [1e-4, 2e3, "no", "on", "yes", True, 1.5, -1, 40, 32, 31, 8.5]
    text = ["1:30", "1_000", "2026-01-31", "0b1", "=", "<<"]
    assert READER.parse(f"[{', '.join(written.split())}, ~, null]", "here") == [
        *as_1_2,
        *text,
        None,
        None,
    ]


def test_a_file_extends_another_key_by_key_but_for_another_kind(tmp_path: Path) -> None:
    below = "a: {x: 1, y: 2}\nb: {kind: one, x: 1}\nc: {kind: one, x: 1}\nd: [1, 2]\n"
    (tmp_path / "below.yaml").write_text(below)
    over = "extends: below.yaml\na: {y: 3}\nb: {kind: two, z: 1}\nc: {y: 2}\nd: [3]\n"
    (tmp_path / "over.yaml").write_text(over)
    assert READER.read(tmp_path / "over.yaml") == {
        "a": {"x": 1, "y": 3},
        "b": {"kind": "two", "z": 1},
        "c": {"kind": "one", "x": 1, "y": 2},
        "d": [3],
    }


def test_merging_changes_neither() -> None:
    one, other = {"a": {"x": 1}}, {"a": {"y": 2}}
    assert merged(one, other) == {"a": {"x": 1, "y": 2}}
    assert (one, other) == ({"a": {"x": 1}}, {"a": {"y": 2}})


@pytest.mark.parametrize(
    ("text", "describe"),
    [
        ("a: 1\nb: {c: 1,\n  c: 2}\n", r"it\.yaml: line 3: key 'c' is written twice"),
        ("a: [\n", r"it\.yaml: not YAML"),
        ("", r"it\.yaml: found nothing; allowed: a mapping"),
        ("- 1\n", r"it\.yaml: found the list \[1\]; allowed: a mapping"),
        ("extends: 3\n", r"it\.yaml\.extends: found 3; allowed: the name of a file"),
        ("extends: it.yaml\n", "extend each other in a circle"),
        ("extends: other.yaml\n", r"it\.yaml\.extends: found 'other\.yaml'; no such file"),
        ("a: \xff\n", "not YAML"),  # no text in UTF-8
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, text: str, describe: str) -> None:
    path = tmp_path / "it.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=describe):
        READER.read(path)
