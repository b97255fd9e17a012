"""The optional libraries of this room, loaded when first used; their absence is one clear line."""

import importlib
import os
from types import ModuleType

from ..errors import MissingDependencyError

INSTALL_COMMAND = "pip install 'raytwin[segmentation]'"


def load_torch() -> ModuleType:
    """torch, or MissingDependencyError with the command that installs it."""
    return _load("torch")


def load_segmentation_models() -> ModuleType:
    """segmentation_models_pytorch, or MissingDependencyError with the command that installs it."""
    return _load("segmentation_models_pytorch")


def _load(name: str) -> ModuleType:
    # Threads that wait by spinning make a step ten times slower wherever other work shares the processor. Read once,
    # when torch's runtime starts; whoever has set it already is obeyed.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingDependencyError(
            f"segmentation networks need {name}, which cannot be imported ({error}); install it with"
            f" `{INSTALL_COMMAND}`"
        ) from None
