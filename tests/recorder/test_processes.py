"""Worker processes: a lost worker is reported; current calls are finished or stopped."""

import os
import signal
import time

import pytest

from recorder.processes import WorkerLost, Workers
from tactile.__main__ import main


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


def test_processes_are_stopped_when_another_call_failed():
    long = []

    def fail():
        with Workers(2) as workers:
            long.append(workers.submit(time.sleep, 60))
            assert workers.submit(divmod, 7, 2).result() == (3, 1)
            workers.submit(divmod, 1, 0).result()

    with pytest.raises(ZeroDivisionError):
        fail()
    assert long[0].exception() is not None


def test_every_process_begins_as_it_was_told():
    with Workers(1, os.chdir, "/") as workers:
        assert workers.submit(os.getcwd).result() == "/"


def test_processes_divide_the_cores_unless_the_environment_has_a_number(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr("recorder.processes.cores", lambda: 7)
    with Workers(2) as workers:
        assert workers.submit(os.getenv, "OMP_NUM_THREADS").result() == "3"
    assert "OMP_NUM_THREADS" not in os.environ
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    with Workers(2) as workers:
        assert workers.submit(os.getenv, "OMP_NUM_THREADS").result() == "5"


@pytest.mark.parametrize(("given", "found"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_of_a_command_wait_without_spinning_unless_told(given, found, monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if given:
        monkeypatch.setenv("OMP_WAIT_POLICY", given)
    assert main(["--version"]) == 0
    assert os.environ["OMP_WAIT_POLICY"] == found
    # `main` has set it outside of monkeypatch's record.
    monkeypatch.setenv("OMP_WAIT_POLICY", found)
    monkeypatch.delenv("OMP_WAIT_POLICY")
