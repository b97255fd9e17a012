"""Settings of all tests: no deadline for hypothesis, as machines differ in speed, and examples that do not vary."""

from hypothesis import settings

settings.register_profile("house", deadline=None, derandomize=True)
settings.load_profile("house")
