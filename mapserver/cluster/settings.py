"""Settings of the cluster that a map server uses."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta


@dataclass(frozen=True)
class ClusterSettings:
    """Processes of a Ray cluster among which the place index is split, and that compare nodes.

    Attributes:
        ray: address of the cluster; `auto` joins the one that runs on this machine, or starts one; empty:
            none.
        shards: parts of the place index. A map stays whole in one.
        timeout: time in which a shard must answer a lost robot's question, s. Without it the answer is
            partial.
    """

    ray: str = ""
    shards: Annotated[int, Meta(ge=1, le=256)] = 4
    timeout: Annotated[float, Meta(ge=0.05, le=60.0)] = 1.0
