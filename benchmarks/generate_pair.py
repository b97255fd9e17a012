"""Noise, spread and readout of a pair of frames against numpy's normal numbers and against the paper's recipe.

    python benchmarks/generate_pair.py [--turns 15] [--device cuda]

A pair is 2 x 760 x 956 pixels at the levels of 20 ms: 40 kV 90 to 240 photons, 90 kV 800 to 2000. The turns of all take
place one after the other in one process. `cpu` is the time of all threads together, which other programs do not lengthen as
they do `wall`; the peers run in one thread, so for them both are the same on an idle machine.
"""

import argparse
import os
import time
from collections.abc import Callable

import numpy as np

from raytwin.generator import noise_kernel_1d, project_polychromatic, sample_frames
from raytwin.generator.references.as_published import sample_as_published

SHAPE = (760, 956)
SIGMA_PX = 0.6
ENERGIES = 100


def level_maps(rng: np.random.Generator) -> np.ndarray:
    """Smooth maps of photons between the ends of each kV."""
    ramp = np.linspace(0.0, 1.0, SHAPE[1], dtype=np.float32)[None, :] * np.ones((SHAPE[0], 1), np.float32)
    ramp = np.clip(ramp + rng.normal(0.0, 0.02, SHAPE), 0.0, 1.0).astype(np.float32)
    return np.stack([90.0 + 150.0 * ramp, 800.0 + 1200.0 * ramp])


def timed(work: dict[str, Callable[[], object]], turns: int) -> dict[str, tuple[float, float]]:
    """Median wall and processor seconds of each piece of work, run in turn."""
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in work}
    for one in work.values():
        one()  # compiled or read from the cache, not timed
    for _ in range(turns):
        for name, one in work.items():
            wall, processor = time.perf_counter(), time.process_time()
            one()
            found[name].append((time.perf_counter() - wall, time.process_time() - processor))
    return {
        name: (float(np.median(np.array(t)[:, 0])), float(np.median(np.array(t)[:, 1]))) for name, t in found.items()
    }


def on_torch(device: str, settings: dict[str, object], turns: int) -> None:
    """Pairs a second from thickness maps that lie on the device, and the share of its memory's speed that they need."""
    import torch

    rng = np.random.default_rng(5)
    on_cuda = torch.device(device).type == "cuda"
    pairs = 16 if on_cuda else 1

    def wait() -> None:
        if on_cuda:
            torch.cuda.synchronize()

    paths = np.stack([rng.uniform(5, 30, (pairs, *SHAPE)), rng.uniform(0, 2, (pairs, *SHAPE))]).astype(np.float32)
    thickness = torch.from_numpy(paths).to(device)
    # maps of the detector lie on the device, too
    settings = {
        name: torch.from_numpy(value).to(device) if isinstance(value, np.ndarray) and value.shape == SHAPE else value
        for name, value in settings.items()
    }
    energies_keV = np.linspace(15.0, 90.0, ENERGIES)
    mu = np.stack([0.02 + 0.08 * (20 / energies_keV) ** 3, 0.03 + 0.5 * (20 / energies_keV) ** 3])
    fluence = {at: 60.0 * np.exp(-(((energies_keV - at) / 15) ** 2)) for at in (30.0, 50.0)}
    # what is above dark and the gain behind the object, from one projection each
    weights = [np.stack([number * energies_keV, number * energies_keV**2]) / 30.0 for number in fluence.values()]

    def rendered(backend: str) -> list[object]:
        frames = []
        for frame, weight in enumerate(weights):
            signal, variance = project_polychromatic(thickness, mu, weight, backend=backend, device=device)
            own = {**settings, "gain_DN": variance / signal / 20.0, "first_frame": frame * pairs}
            frames.append(sample_frames(signal, backend=backend, device=device, **own))  # type: ignore[arg-type]
        return frames

    for backend in ("torch", "torch_compiled"):
        rendered(backend)  # compiled, not timed
        wait()
        seconds = []
        for _ in range(turns):
            begin = time.perf_counter()
            rendered(backend)
            wait()
            seconds.append((time.perf_counter() - begin) / pairs)
        # the least that a pair moves: of each kV two thicknesses in and one frame out, in single precision; the detector's
        # maps are read again for every frame, but stay in a GPU's cache
        least = 2 * 4 * (2 + 1) * SHAPE[0] * SHAPE[1]
        speed = least / float(np.median(seconds))
        line = f"{device}, {backend}: {1 / np.median(seconds):.0f} pairs a second, {speed / 1e9:.1f} GB/s in and out"
        if on_cuda:
            copied = copied_bytes_a_second(device)
            line += f", {100 * speed / copied:.0f} % of a copy's {copied / 1e9:.0f} GB/s"
        print(line)


def copied_bytes_a_second(device: str) -> float:
    """Bytes read and written a second by copies of 1 GiB within the device, median of eleven after three."""
    import torch

    source = torch.rand(2**28, dtype=torch.float32, device=device)
    target = torch.empty_like(source)
    seconds = []
    for turn in range(14):
        torch.cuda.synchronize()
        begin = time.perf_counter()
        target.copy_(source)
        torch.cuda.synchronize()
        if turn >= 3:
            seconds.append(time.perf_counter() - begin)
    return 2.0 * source.numel() * source.element_size() / float(np.median(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--device", help="also time torch on this device, for example cuda")
    arguments = parser.parse_args()
    rng = np.random.default_rng(1)
    levels = level_maps(rng)
    dark = rng.uniform(1100.0, 1400.0, SHAPE).astype(np.float32)
    relative = rng.normal(1.0, 0.02, SHAPE).astype(np.float32)
    settings = {
        "gain_DN": 1.95,
        "key": 1,
        "gain_relative": relative,
        "white_fraction": 0.02,
        "kernel_1d": noise_kernel_1d("aperture", SIGMA_PX),
        "read_noise_DN": 12.9,
        "dark_DN": dark,
        "bits": 16,
    }
    signal = levels * np.float32(1.95)
    number = 2 * SHAPE[0] * SHAPE[1]
    published = {"gain_DN": 1.95, "read_noise_DN": 12.9, "blur_px": 0.8, "dark_DN": dark}
    work = {
        "raytwin": lambda: sample_frames(signal, **settings),
        "numpy standard_normal float32": lambda: rng.standard_normal(number, dtype=np.float32),
        "numpy poisson": lambda: rng.poisson(levels),
        "as_published": lambda: [sample_as_published(one, rng=rng, **published) for one in signal],
    }
    times = timed(work, arguments.turns)
    mine = times["raytwin"]
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, medians of {arguments.turns} turns")
    for name, (wall, processor) in times.items():
        print(
            f"{name:32s} wall {1e3 * wall:7.1f} ms ({wall / mine[0]:5.2f} of raytwin)"
            f"   cpu {1e3 * processor:7.1f} ms ({processor / mine[1]:5.2f} of raytwin)"
        )
    if arguments.device:
        on_torch(arguments.device, settings, arguments.turns)


if __name__ == "__main__":
    main()
