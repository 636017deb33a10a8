"""The names of `recorder` are imported on demand."""

import pytest
from support.commands import python


def test_settings_are_read_without_zarr() -> None:
    code = "import sys, recorder.settings; print('zarr' in sys.modules, 'yaml' in sys.modules)"
    assert python("-c", code).stdout == "False True\n"


@pytest.mark.parametrize(
    "before", ["recorder.checks", "recorder.checks.recover", "recorder.settings"]
)
def test_check_is_the_function_whatever_was_imported_before(before: str) -> None:
    code = f"import {before}; from recorder import check; import recorder.checks.recover; "
    code += "import recorder; print(check.__module__, recorder.check is check)"
    assert python("-c", code).stdout == "recorder.checks.check True\n"
