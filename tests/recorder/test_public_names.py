"""The names of `recorder` are imported on demand."""

import subprocess
import sys

import pytest

import recorder


def python(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=240
    )
    return done.stdout


def test_settings_are_read_without_zarr() -> None:
    code = "import sys, recorder.settings; print('zarr' in sys.modules, 'yaml' in sys.modules)"
    assert python(code) == "False True\n"


@pytest.mark.parametrize(
    "before", ["recorder.checks", "recorder.checks.recover", "recorder.settings"]
)
def test_check_is_the_function_whatever_was_imported_before(before: str) -> None:
    code = f"import {before}; from recorder import check; import recorder.checks.recover; "
    code += "import recorder; print(check.__module__, recorder.check is check)"
    assert python(code) == "recorder.checks.check True\n"


def test_every_public_name_is_found_and_no_other() -> None:
    for name in recorder.__all__:
        assert getattr(recorder, name) is not None
    missing = "Sitting"
    with pytest.raises(AttributeError, match="no attribute 'Sitting'"):
        getattr(recorder, missing)
