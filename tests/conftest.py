"""Settings of all tests: one compiled thread a worker, no deadline for hypothesis, and examples that do not vary."""

import os

from hypothesis import settings

# small frames spend their time waiting for threads, and the workers of the test run fill the cores already
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

settings.register_profile("house", deadline=None, derandomize=True)
settings.load_profile("house")
