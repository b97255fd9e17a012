"""What a process that `Children` started does with its standard input: read its task, and end when its parent is gone."""

import os
import sys
import threading


def line_from_parent() -> str:
    """The line that the parent gave; from then on the process ends as soon as standard input does.

    The parent holds the other end open while it lives, however it ends.
    """
    line = sys.stdin.readline()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    return line


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)
