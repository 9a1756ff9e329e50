"""The maps of the recorded fleet."""

from functools import cache
from pathlib import Path

from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import MapId
from mapweave.storage.map_file import read_map_file
from mapweave.wire.codec import element_of

RECORDING = Path(__file__).with_name("fleet.mapweave")
DEMO_PAGE = Path(__file__).with_name("page.shown")
"""What the page shows of them at once; see `mapserver.http.loading`."""
VERDICTS = Path(__file__).with_name("fleet.verdicts")
"""What comparing their nodes has found, which a server takes over for nodes with the same landmarks; see
`mapserver.merging.verification_cache_keeper`.

`python -m synthetic.recorded_fleet` makes all three.
"""


@cache
def recorded_maps() -> dict[MapId, list[ChangeBody]]:
    """Each robot's changes, in the order in which it made them.

    Raises:
        InvalidFile: the file is damaged.
    """
    maps: dict[MapId, list[ChangeBody]] = {}
    for change in read_map_file(RECORDING).changes:
        maps.setdefault(element_of(change).map, []).append(change)
    return maps
