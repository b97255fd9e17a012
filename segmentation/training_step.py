"""One step of training; on a GPU it is recorded once and replayed, since launching its operations takes longer than they do."""

from typing import Any

from numpy.typing import NDArray

from ._torch import load_torch
from .losses import LOSSES
from .network import tensor_from_array
from .recipe import Recipe

_STEPS_BEFORE_RECORDING = 3  # make what torch makes at first use; its notes on CUDA graphs ask for three


class TrainingStep:
    """A network, its loss and its optimizer: called with a batch, the network learns from it.

    The first steps on a GPU are done operation by operation; the next one is recorded as a CUDA graph, which that step and all later
    ones replay: the same operations on the same places of memory.

    Args:
        network: torch.nn.Module on the device.
        recipe: its loss and optimizer are used.
        device: torch device.
        record: whether steps on a GPU are recorded; those of a module whose Python code decides by what it sees cannot be.

    Source: Nguyen et al. 2021, "Accelerating PyTorch with CUDA Graphs" (pytorch.org/blog).
    """

    def __init__(self, network: Any, *, recipe: Recipe, device: str, record: bool = True) -> None:
        torch = load_torch()
        self._network = network
        self._loss_function = LOSSES[recipe.loss]
        self._device = device
        self._on_gpu = device.startswith("cuda")
        self._record = record and self._on_gpu
        self._done = 0
        self._replay: Any = None
        make = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[recipe.optimizer]
        rate = recipe.learning_rate
        # on a GPU a recorded step reads its rate and the count of steps anew
        self._own = {
            "lr": torch.tensor(rate, device=device) if self._on_gpu else rate,
            "capturable": self._on_gpu,
        }
        self.optimizer = make(network.parameters(), weight_decay=recipe.weight_decay, **self._own)

    def go_on_from(self, optimizer: Any) -> None:
        """Take over an optimizer's state (its `state_dict`), of a processor or of a GPU."""
        groups = [{**group, **self._own} for group in optimizer["param_groups"]]
        self.optimizer.load_state_dict({**optimizer, "param_groups": groups})

    def __call__(self, images: NDArray[Any], masks: NDArray[Any], *, rate: float) -> Any:
        """Learn from one batch.

        Args:
            images: (image, channel, row, column) scaled; every batch has the same shape.
            masks: (image, class, row, column), 0 or 1.
            rate: learning rate of this step.

        Returns:
            The loss before the step, a tensor on the device: reading it waits for the device.
        """
        self._set_rate(rate)
        batch = (tensor_from_array(images, device=self._device), tensor_from_array(masks, device=self._device))
        self._done += 1
        if not self._record:
            return self._step(*batch)
        if self._done <= _STEPS_BEFORE_RECORDING:
            return self._step_beside(*batch)
        if self._replay is None:
            self._replay = self._recorded(*batch)
        return self._replay(*batch)

    def _set_rate(self, rate: float) -> None:
        for group in self.optimizer.param_groups:
            if self._on_gpu:
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate

    def _step(self, images: Any, masks: Any) -> Any:
        loss = self._loss_function(self._network(images), masks)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return loss.detach()

    def _step_beside(self, images: Any, masks: Any) -> Any:
        """A step on a stream of its own, as what is recorded later asks for."""
        cuda = load_torch().cuda
        with cuda.device(self._device):
            beside = cuda.Stream()
            beside.wait_stream(cuda.current_stream())
            with cuda.stream(beside):
                loss = self._step(images, masks)
            cuda.current_stream().wait_stream(beside)
        return loss

    def _recorded(self, images: Any, masks: Any) -> Any:
        """The step as a graph, and what replays it with another batch; recording does not learn."""
        cuda = load_torch().cuda
        graph = cuda.CUDAGraph()
        self.optimizer.zero_grad()
        with cuda.device(self._device), cuda.graph(graph):
            loss = self._step(images, masks)

        def replay(new_images: Any, new_masks: Any) -> Any:
            images.copy_(new_images)
            masks.copy_(new_masks)
            graph.replay()
            return loss.clone()

        return replay
