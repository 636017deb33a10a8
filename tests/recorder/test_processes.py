"""Worker processes: a lost worker is reported; current calls are finished or stopped."""

from __future__ import annotations

import os
import signal
import time

import pytest

from recorder.processes import WorkerLost, Workers


@pytest.mark.parametrize(
    ("end", "given", "message"),
    [
        (signal.raise_signal, signal.SIGKILL, r"SIGKILL, most likely .*, 2 of 3 done; .*fewer"),
        (os._exit, 3, r"ended with exit code 3, 2 of 3 done; .*__main__"),
    ],
)
def test_a_lost_process_is_told_of(end, given, message):
    workers = Workers(1)
    workers.done = "2 of 3"
    with pytest.raises(WorkerLost, match=message), workers:
        workers.submit(end, given).result()


@pytest.mark.parametrize("patient", [True, False])
def test_patient_processes_end_what_they_are_at_when_another_call_failed(patient):
    long = []

    def fail():
        with Workers(2, patient=patient) as workers:
            long.append(workers.submit(time.sleep, 2 if patient else 60))
            assert workers.submit(divmod, 7, 2).result() == (3, 1)
            workers.submit(divmod, 1, 0).result()

    with pytest.raises(ZeroDivisionError):
        fail()
    assert (long[0].exception() is None) == patient


def test_every_process_begins_as_it_was_told():
    with Workers(1, os.chdir, "/") as workers:
        assert workers.submit(os.getcwd).result() == "/"
