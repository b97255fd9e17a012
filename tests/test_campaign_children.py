"""Processes of their own: what they say when they fail, that none outlives its run, one run in a folder."""

import os
import threading
import time

import pytest

from raytwin.campaign._children import ChildError, Children, KilledError, StoppedError
from raytwin.campaign._once import only_one
from raytwin.errors import InputError

# with standard input left open this one waits for its end
WAITING = {"module": "blind_measure", "given": "{}", "environment": os.environ, "leash": True}


def test_a_child_that_fails_is_told_by_its_last_line():
    with pytest.raises(ChildError, match=r"^KeyError: 'label'$"):
        Children().run("blind_measure", given="{}", environment=os.environ)


def test_a_child_that_takes_too_long_is_ended():
    children = Children()
    with pytest.raises(ChildError, match=r"^took longer than 0\.2 s$"):
        children.run(**WAITING, timeout_s=0.2)
    assert not children._running


@pytest.mark.parametrize(
    ("end", "error", "message"),
    [
        (lambda children: next(iter(children._running)).kill(), KilledError, "^ended by SIGKILL$"),
        (Children.stop, StoppedError, "^$"),
    ],
)
def test_a_killed_child_is_told_and_a_stopped_one_is_not_its_failure(end, error, message):
    children = Children()

    def interfere():
        while not children._running:
            time.sleep(0.01)
        end(children)

    thread = threading.Thread(target=interfere)
    thread.start()
    with pytest.raises(error, match=message):
        children.run(**WAITING, timeout_s=60.0)
    thread.join()
    assert not children._running


def test_nothing_is_started_after_a_stop():
    children = Children()
    children.stop()
    with pytest.raises(StoppedError):
        children.run("no_such_module", given="", environment=os.environ)


def test_a_folder_is_one_runs_until_it_ends(tmp_path):
    pytest.importorskip("fcntl")
    with (
        only_one(tmp_path, "a sweep"),
        pytest.raises(InputError, match="where a sweep is running; expected a folder that no"),
    ):
        only_one(tmp_path, "a sweep").__enter__()
    with only_one(tmp_path, "a sweep"):
        pass
