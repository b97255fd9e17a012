"""Processes of their own: what they say when they fail, that none outlives its run, one run in a folder."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from raytwin.campaign._children import ChildError, Children, KilledError, StoppedError
from raytwin.errors import InputError
from raytwin.files import only_one

# minutes of work
LABEL = {
    "stream": "test",
    "index": 0,
    "session_seed": 1,
    "label": "none",
    "effects": [],
    "protocol": "full",
    "geometry": "coarse",
    "leave_out": [],
}
LONG_TASK = json.dumps({"label": LABEL, "path": "never.h5", "size": 256, "frames": 300})


@pytest.fixture
def long_work(tmp_path):
    """What to start a child with that will not be done soon."""
    return {"module": "blind_measure", "given": LONG_TASK, "environment": os.environ, "folder": tmp_path}


def test_a_child_that_fails_is_told_by_its_last_line():
    with pytest.raises(ChildError, match=r"^KeyError: 'label'$"):
        Children().run("blind_measure", given="{}", environment=os.environ)


def test_a_child_that_takes_too_long_is_ended(long_work):
    children = Children()
    with pytest.raises(ChildError, match=r"^took longer than 0\.2 s$"):
        children.run(**long_work, timeout_s=0.2)
    assert not children._running


@pytest.mark.parametrize(
    ("end", "error", "message"),
    [
        (lambda children: next(iter(children._running)).kill(), KilledError, "^ended by SIGKILL$"),
        (Children.stop, StoppedError, "^$"),
    ],
)
def test_a_killed_child_is_told_and_a_stopped_one_is_not_its_failure(end, error, message, long_work):
    children = Children()

    def interfere():
        while not children._running:
            time.sleep(0.01)
        end(children)

    thread = threading.Thread(target=interfere)
    thread.start()
    with pytest.raises(error, match=message):
        children.run(**long_work, timeout_s=60.0)
    thread.join()
    assert not children._running


def test_no_child_outlives_a_parent_that_was_killed(tmp_path):
    """The parent says its child's number and is killed while it waits; the child has minutes of work left."""
    script = (
        "import os, threading, time; from pathlib import Path; from raytwin.campaign._children import Children;"
        "children = Children();"
        f"run = lambda: children.run('blind_measure', given={LONG_TASK!r}, environment=os.environ, folder=Path('.'));"
        "threading.Thread(target=run).start();"
        "time.sleep(3.0);"
        "print(next(iter(children._running)).pid, flush=True)"
    )
    words = [sys.executable, "-c", script]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as parent:
        child = int(parent.stdout.readline())
        assert _runs(child)
        parent.kill()
    for _ in range(100):
        if not _runs(child):
            return
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the child went on")


def _runs(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_nothing_is_started_after_a_stop():
    children = Children()
    children.stop()
    with pytest.raises(StoppedError):
        children.run("no_such_module", given="", environment=os.environ)


def test_a_folder_is_one_runs_until_it_ends(tmp_path):
    with (
        only_one(tmp_path, "a sweep"),
        pytest.raises(InputError, match="where a sweep is running; expected a folder that no"),
    ):
        only_one(tmp_path, "a sweep").__enter__()
    with only_one(tmp_path, "a sweep"):
        pass
