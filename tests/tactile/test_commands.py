"""The command `tactile`: its table, its help, and unknown commands."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
from support import reference
from support.commands import python

from recorder.command_line.extras import LIBRARIES, extra_of
from tactile.__main__ import main
from tactile.commands import COMMANDS, EXTRAS, FAMILIES, GROUPS, INTERRUPTED, Command
from tactile.run import overview

OURS = ("trajectories", "rig", "sim", "learning")
# The only part of `recorder` that help loads.
TABLE = "recorder.command_line"


@pytest.mark.parametrize("package", ["rig", "recorder", "sim", "learning", "tactile"])
def test_every_module_of_commands_is_in_the_table_once(package: str) -> None:
    found = [
        ".".join(path.relative_to(reference.ROOT).with_suffix("").parts)
        for path in reference.ROOT.joinpath(package).rglob("*.py")
        if "\ndef add_arguments(parser" in path.read_text()
    ]
    listed = [command.module for command in COMMANDS.values() if command.package == package]
    assert sorted(listed) == sorted(found)


def test_the_words_of_a_command_are_its_own_and_none_is_lost_between_groups() -> None:
    assert len(COMMANDS) == sum(map(len, GROUPS.values()))
    for words in COMMANDS:
        first, *rest = words.split()
        assert len(rest) == (first in FAMILIES)
    assert {command.package for command in COMMANDS.values()} == set(EXTRAS) > set(INTERRUPTED)


@pytest.mark.parametrize("command", COMMANDS.values(), ids=lambda each: each.words)
def test_a_command_shows_its_own_name_in_its_usage(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command.words.split(), "--help"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: tactile {command.words} ")


HELPS = (["--help"], ["-h"], [], ["session", "--help"], ["train"], ["nosuch"], ["sim", "nosuch"])


@pytest.mark.parametrize("words", HELPS, ids=" ".join)
def test_help_imports_the_table_alone(words: list[str]) -> None:
    """No numpy, which keeps help fast."""
    code = f"""
import sys
from tactile.__main__ import main
main({words!r})
known = {{name.partition(".")[0] for name in sys.modules}}
others = {{name for name in sys.modules if name.startswith("recorder.") and {TABLE!r} not in name}}
others -= {{"recorder.on_demand"}}
print("loaded:", sorted(known & {{"numpy", "zarr", "argparse", *{OURS!r}}} | others))
"""
    assert python("-c", code).stdout.splitlines()[-1] == "loaded: []"


@pytest.mark.slow
def test_a_command_loads_its_own_package_alone() -> None:
    code = """
import contextlib, sys
from tactile.__main__ import main
with contextlib.suppress(SystemExit):
    main(["session", "info", "--help"])
print(sorted({name.partition(".")[0] for name in sys.modules} & {"rig", "sim", "learning"}))
"""
    assert python("-c", code).stdout.splitlines()[-1] == "[]"


def test_the_overview_names_every_command_in_lines_of_a_terminal() -> None:
    text = overview()
    for title, commands in GROUPS.items():
        assert f"\n{title}\n" in text
        for command in commands:
            assert f"  {command.words} " in text
    assert max(map(len, text.splitlines())) < 100


@pytest.mark.parametrize("first", FAMILIES)
def test_a_family_lists_its_commands_and_no_other(first: str) -> None:
    listed = [line.split()[:2] for line in overview(family=first).splitlines()[3:]]
    assert listed == [words.split() for words in COMMANDS if words.split()[0] == first]


@pytest.mark.parametrize(
    ("words", "near"),
    [
        (["colect"], "did you mean collect"),
        (["check"], "did you mean session check?"),
        (["train-force"], "did you mean train force?"),
        (["press"], "did you mean sim press?"),
        (["session", "chekc"], "did you mean session check"),
        (["xyzzy"], "no such command; tactile --help"),
        (["sim", "force"], "'sim force': no such command"),
    ],
)
def test_an_unknown_command_is_refused_and_the_nearest_are_named(
    words: list[str], near: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    message = capsys.readouterr()
    assert near in message.err
    assert not message.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("session check", "the following arguments are required: session"),
        ("session check x.zarr --deep", "unrecognized arguments: --deep"),
        ("sim press --hold 0", "--hold: found '0'; allowed: a number above 0"),
        ("sim archive states --indenters cone,", "--indenters: found 'cone,'; allowed: names"),
        ("collect --sensor a --bench b", "--bench: not allowed with argument --sensor"),
    ],
)
def test_a_wrong_option_is_one_line_that_names_its_help(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"wrong input: {message}")
    assert line.endswith(" --help")


@pytest.mark.parametrize(
    ("words", "missing", "extra"),
    [
        (["sim", "press", "--depths", "1"], "warp", "sim"),
        (["train", "force", "--help"], "learning.force.command", ""),
    ],
)
def test_a_missing_library_names_the_extra_and_a_missing_module_of_ours_is_a_fault(
    words: list[str],
    missing: str,
    extra: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    for name in [each for each in sys.modules if each.startswith("sim.tiers")]:
        monkeypatch.delitem(sys.modules, name)
    if not extra:
        with pytest.raises(ModuleNotFoundError):
            main(words)
        return
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert missing in line
    assert line.endswith(f"pip install 'tactile-rig[{extra}]'")


def test_the_pages_of_reference_are_those_of_the_table_and_the_packages() -> None:
    for name, page in reference.PAGES.items():
        written = (reference.FOLDER / name).read_text()
        assert written == page(), f"docs/reference/{name} is old: make reference"


IMPORTED = re.compile(
    r"^ *(?:import (?=[\w.]+(?: as \w+)?(?: +#.*)?$)|from (?=[\w.]+ import ))(\w+)", re.MULTILINE
)


def _imported() -> set[str]:
    """Return the libraries that the packages import anywhere, by the names of their modules."""
    found = set()
    for package in (*OURS, "recorder", "tactile"):
        for path in reference.ROOT.joinpath(package).rglob("*.py"):
            found |= set(IMPORTED.findall(path.read_text()))
    return found - set(sys.stdlib_module_names) - {*OURS, "recorder", "tactile"}


def test_every_library_is_of_the_base_or_of_an_extra_that_exists() -> None:
    project = tomllib.loads((reference.ROOT / "pyproject.toml").read_text())["project"]
    # Libraries whose modules are not named as they are.
    modules = {"google-crc32c": "google_crc32c", "pillow": "PIL", "pyyaml": "yaml"}
    names = [re.match(r"[\w-]+", each)[0] for each in project["dependencies"]]  # type: ignore[index]
    base = {modules.get(name, name) for name in names}
    assert _imported() - base <= set(LIBRARIES)
    assert {extra for extras in LIBRARIES.values() for extra in extras} <= set(
        project["optional-dependencies"]
    )


@pytest.mark.slow
def test_a_missing_library_of_pictures_is_named_with_the_command_that_installs_it(
    tmp_path: Path,
) -> None:
    words = ["sim", "press", "--tier", "layer", "--depths", "0.2", "--out", "x.png"]
    code = (
        "import sys; sys.modules['matplotlib'] = None\n"
        f"from tactile.__main__ import main; sys.exit(main({words!r}))"
    )
    ran = python("-c", code, folder=tmp_path, code=2)
    assert "Traceback" not in ran.stderr
    assert "pip install 'tactile-rig[sim]'" in ran.stderr


def test_the_extra_of_the_command_is_preferred() -> None:
    assert extra_of("scipy.linalg", "sim") == "sim"
    assert extra_of("scipy", "rig,learning") == "rig,learning"
    assert extra_of("cv2", "rig") == "rig"
    assert extra_of("h5py", "rig") == "export"
    assert extra_of("recorder", "rig") == ""
