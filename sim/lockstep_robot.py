"""A robot of the simulation whose agent can wait for the other robots: what repeatable runs need."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from mapweave.agent.drivers.remote import PATIENCE, RemoteRobot
from mapweave.hybridmap.limits import MAX_NUMBER
from mapweave.sim.keys import SimKeys
from mapweave.wire.bus import Bus
from mapweave.wire.packing import Limit
from mapweave.wire.typed import decode, encode

LIMIT = Limit("rendezvous", 64)
"""It is one number."""


@dataclass(frozen=True, slots=True)
class Rendezvous:
    """A step that moves nothing: answered with nothing when every other robot has finished the tick.

    No time passes. A question that an agent asks the fleet right then has an answer that does not depend on
    how quick the other robots were.

    Attributes:
        sequence: counts together with the steps of the same robot.
    """

    sequence: Annotated[int, Meta(ge=1, le=MAX_NUMBER)]


def encode_rendezvous(step: Rendezvous) -> bytes:
    """Encode it."""
    return encode(step, LIMIT)


def decode_rendezvous(data: bytes) -> Rendezvous:
    """Decode it.

    Raises:
        InvalidMessage: anything is wrong with it.
    """
    return decode(data, Rendezvous, LIMIT)


class LockstepRobot(RemoteRobot):
    """A simulated robot behind Zenoh keys."""

    def __init__(self, bus: Bus, fleet: str, name: str) -> None:
        """Nothing is asked yet; see RemoteRobot."""
        super().__init__(bus, fleet, name, PATIENCE)
        self._rendezvous_key = SimKeys(fleet).rendezvous(name)

    def rendezvous(self) -> None:
        """Wait until every other robot of the simulation has finished this tick; no time passes.

        Raises:
            DeviceError: no answer, or a malformed one.
        """
        if self._closed.is_set():
            return
        step = Rendezvous(self._sequence + 1)
        self._ask(self._rendezvous_key, encode_rendezvous(step), bytes)
        self._sequence += 1
