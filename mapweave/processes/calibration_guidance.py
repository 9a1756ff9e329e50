"""Guidance while a person holds the calibration target before the camera: four bars and what to do next."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from mapweave.agent.drivers.camera import FrameSource
from mapweave.hybridmap.errors import DeviceError
from mapweave.vision.calibration.collection import Guidance, ViewCollection
from mapweave.vision.calibration.coverage import NAMES, ViewCoverage

PATIENCE = 5.0
"""s without a frame after which the camera has ended."""


def guide(
    camera: FrameSource, collection: ViewCollection, console: Console
) -> Iterator[tuple[NDArray[np.uint8], Guidance]]:
    """Look at the newest frames until the views suffice or the stream ends.

    Yields:
        Each frame, (H, W) grey, and what it added.

    Raises:
        DeviceError: no frame has ever come.
    """
    stamp_ns, frames = 0, 0
    with Live(console=console, refresh_per_second=8, transient=True) as shown:
        while collection.done is None:
            frame = camera.newer(stamp_ns, PATIENCE)
            if frame is None:
                if not frames:
                    raise DeviceError("the camera delivers no images")
                return
            stamp_ns, frames = frame.stamp_ns, frames + 1
            guidance = collection.see(frame.image, f"frame {frames}")
            shown.update(panel(guidance))
            yield frame.image, guidance


def panel(guidance: Guidance) -> Group:
    """The bars, and what to do next."""
    return Group(bars(guidance.coverage), Text(guidance.hint, style="bold"))


def bars(coverage: ViewCoverage) -> Table:
    """Coverage in x, y, size and skew."""
    table = Table.grid(padding=(0, 1))
    for name, share in zip(NAMES, coverage.bars.tolist(), strict=True):
        table.add_row(name, ProgressBar(total=1.0, completed=share, width=40), f"{100 * share:.0f} %")
    table.add_row("views", str(coverage.views))
    return table
