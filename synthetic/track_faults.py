"""What goes wrong with tracks: they jump, slide away, stick to a walking person, change places."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from synthetic.mapping_run import TICK, MappingRun

KINDS = ("jump", "slide", "walk", "swap")


def spoil(run: MappingRun, share: float, rng: np.random.Generator) -> tuple[MappingRun, NDArray[np.bool_]]:
    """Spoil a share of a run's tracks, each from a random time on, the walkers among them together.

    Returns:
        The run with spoiled pixels, and (N,) which tracks are spoiled.
    """
    n, last = len(run.points), len(run.poses) - 1
    chosen = rng.permutation(n)[: round(share * n)]
    pixels = run.pixels.copy()
    groups = np.array_split(chosen, len(KINDS))
    jumpers, sliders, walkers, swappers = (group.tolist() for group in groups)
    for track in jumpers:
        at = int(rng.integers(1, last))
        pixels[at:, track] += rng.uniform(5.0, 60.0) * _direction(rng)
    for track in sliders:
        at = int(rng.integers(1, last))
        pixels[at:, track] += np.outer(np.arange(last + 1 - at), rng.uniform(0.05, 1.0) * _direction(rng))
        pixels[~run.camera.contains(pixels[:, track]), track] = np.nan
    if walkers:
        at, speed, way = int(rng.integers(0, last)), rng.uniform(0.1, 0.8), _direction(rng)
        for track in walkers:
            for k in range(at, last + 1):
                # There and back within a metre, as a person in a room does.
                offset = abs((speed * TICK * (k - at) + 1.0) % 2.0 - 1.0)
                point = run.points[track] + np.array([*(offset * way), 0.0])
                pixel = run.camera.project(run.poses[k].inverse().apply(point))
                noise = run.pixel_sigma * rng.normal(size=2)
                pixels[k, track] = pixel + noise if run.camera.contains(pixel) else np.nan
    for first, second in zip(swappers[::2], swappers[1::2], strict=False):
        at = int(rng.integers(1, last))
        pixels[at:, [first, second]] = pixels[at:, [second, first]]
    spoiled = np.zeros(n, np.bool_)
    spoiled[chosen] = True
    return replace(run, pixels=pixels), spoiled


def _direction(rng: np.random.Generator) -> NDArray[np.float64]:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])
