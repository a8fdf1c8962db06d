"""Progress, interruption, and an interpreter that stays free."""

from __future__ import annotations

import _thread
import subprocess
import sys
import threading
import time

import pytest

import distributed_observer as do
from conftest import SHORT

#: A run of several seconds.
LONG = {**SHORT, "time.duration": 2000.0, "evaluation": {"from": 1.0, "to": 2.0}, "record.trace_stride": 0, "record.events": False}


@pytest.fixture
def long() -> do.Scenario:
    return do.load("paper", set=LONG)


def test_progress_is_told_until_the_end():
    told = []
    thread = threading.current_thread()

    def progress(done, total):
        assert threading.current_thread() is thread
        told.append((done, total))

    scenario = do.load("paper", set={**LONG, "time.duration": 40.0})
    scenario.run(progress=progress)
    assert told[-1] == (40000, 40000)
    assert told == sorted(told)


def test_an_exception_of_the_callable_ends_the_run(long):
    def progress(done, total):
        raise ValueError("enough")

    start = time.monotonic()
    with pytest.raises(ValueError, match="enough"):
        long.run(progress=progress)
    assert time.monotonic() - start < 2


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is raised differently")
def test_ctrl_c_ends_a_run_soon(long):
    timer = threading.Timer(0.3, _thread.interrupt_main)
    timer.start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        long.run()
    assert time.monotonic() - start < 2


def test_other_threads_of_python_go_on_meanwhile(long):
    count = 0
    end = threading.Event()

    def work():
        nonlocal count
        while not end.is_set():
            count += 1
            time.sleep(0.001)

    thread = threading.Thread(target=work)
    thread.start()
    do.load("paper", set={**LONG, "time.duration": 50.0}).run()
    end.set()
    thread.join()
    assert count > 20


def test_a_bar_needs_tqdm_and_is_shown_on_request(short, capsys):
    pytest.importorskip("tqdm")
    do.load("paper", set={**LONG, "time.duration": 40.0}).run(progress=True)
    assert "%" in capsys.readouterr().err
    short.run(progress=False)
    with pytest.raises(TypeError, match="progress is not callable"):
        short.run(progress=5)


def test_without_pandas_and_tqdm_the_rest_works():
    program = """
import sys
sys.modules["pandas"] = sys.modules["tqdm"] = sys.modules["tqdm.auto"] = None
import distributed_observer as do
scenario = do.load("paper", set={"learning": [], "time.duration": 1.0, "evaluation": {"from": 0.5, "to": 1.0}})
result = scenario.run()
assert result._repr_html_() is None
for call in (result.agents_frame, lambda: scenario.run(progress=True)):
    try:
        call()
    except ModuleNotFoundError as error:
        assert "install it" in str(error)
    else:
        raise AssertionError
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is raised differently")
def test_ctrl_c_ends_a_run_with_a_slow_plant():
    def plant(x, t):
        time.sleep(0.002)
        return [x[1], -x[0]]

    scenario = do.load("duffing", set={"learning": []}).with_plant(plant)
    threading.Timer(0.5, _thread.interrupt_main).start()
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        scenario.run(progress=False)
    assert time.monotonic() - begin < 3.0
