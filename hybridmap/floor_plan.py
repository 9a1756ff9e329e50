"""Floor plans: an image of the building, and the pairs of places by which it lies under the merged map."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import Amount, Coordinate, Number, Probability, Words
from mapweave.hybridmap.pose import Array, Pose2

MAX_PAIRS = 64
"""Of one plan. A limit for messages: three suffice."""
MAX_SIDE = 20_000
"""Of an image, px."""
MAX_BYTES = 16 * 2**20
"""Of an image as PNG: a plan of 6000 x 4000 px in colour takes about 2 MiB, a photograph of one 20."""
PIECE = 2**19
"""Bytes of an image in one message: half of what a router lets through."""
MAX_PARTS = 16
"""Components that lie on one plan."""
IDENTITY = Pose2()

Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
Pixel = Annotated[float, Meta(ge=-MAX_SIDE, le=2 * MAX_SIDE)]
"""From the upper left corner of the image, right or down; the middle of the first pixel is 0.5. Beside the
image is allowed: a plan may be cut off."""
PixelSize = Annotated[float, Meta(ge=1e-6, le=1e3)]
"""m in a pixel."""


@dataclass(frozen=True, slots=True)
class PlanPair:
    """One place, in the map and on the plan.

    Attributes:
        node: from which its position is known.
        x: position in the node's frame, m.
        y: likewise.
        u: where it is on the image, px to the right of its left edge.
        v: px below its upper edge.
    """

    node: NodeId
    x: Coordinate
    y: Coordinate
    u: Pixel
    v: Pixel


@dataclass(frozen=True, slots=True)
class PlanImage:
    """An image by its content.

    Attributes:
        sha256: of the PNG file, hexadecimal.
        width: px.
        height: px.
        file: name of the file that it was.
    """

    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
    width: Side
    height: Side
    file: Annotated[str, Meta(max_length=255)] = ""


@dataclass(frozen=True, slots=True)
class PlanPiece:
    """A piece of an image on its way to a server; pieces come in order.

    Attributes:
        sha256: of the whole PNG file, hexadecimal.
        size: of the whole, bytes.
        offset: where the piece begins; 0 begins again.
        data: the piece.
    """

    sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]
    size: Annotated[int, Meta(ge=1, le=MAX_BYTES)]
    offset: Annotated[int, Meta(ge=0, le=MAX_BYTES)]
    data: Annotated[bytes, Meta(max_length=PIECE)]


@dataclass(frozen=True, slots=True)
class PlanReceived:
    """What a server has of an image.

    Attributes:
        received: bytes.
        image: the image, once it is whole and on the disk.
    """

    received: Number
    image: PlanImage | None = None


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """A plan and its pairs.

    The frame `plan` is in metres. The lower left corner of the image has the pose `origin` in it, as in a
    `map.yaml`; without one, x is right and y is up from that corner.

    Attributes:
        pairs: three or more.
        image: the plan.
        metres_per_pixel: of the image; None: the pairs say it.
        origin: pose of the lower left corner, in `plan`.
    """

    TAG: ClassVar[str] = "plan"
    pairs: Annotated[tuple[PlanPair, ...], Meta(min_length=1, max_length=MAX_PAIRS)]
    image: PlanImage
    metres_per_pixel: PixelSize | None = None
    origin: Pose2 = IDENTITY

    def __post_init__(self) -> None:
        """Refuse no pairs, and the same pixel twice (InvalidValue)."""
        if not 1 <= len(self.pairs) <= MAX_PAIRS:
            raise InvalidValue(f"a plan has 3 to {MAX_PAIRS} pairs, not {len(self.pairs)}")
        if len({(pair.u, pair.v) for pair in self.pairs}) < len(self.pairs):
            raise InvalidValue("two pairs have the same pixel: each place is clicked once")

    @property
    def anchor(self) -> NodeId:
        """The node by which its position is known: the first of several."""
        return self.pairs[0].node

    @property
    def words(self) -> str:
        """The plan in words."""
        scale = "" if self.metres_per_pixel is None else f", {self.metres_per_pixel:g} m/px"
        return f"{self.image.file or 'an image'}, {len(self.pairs)} pairs{scale}"

    @property
    def pixels(self) -> Array:
        """(K, 2) px, of the pairs, to the right and up from the lower left corner of the image."""
        return np.array([(pair.u, self.image.height - pair.v) for pair in self.pairs])


@dataclass(frozen=True, slots=True)
class FittedPair:
    """A pair, and how well it fits.

    Attributes:
        number: in the order in which they were given, from 1.
        node: from which its position is known.
        merged: x, y in the frame of the component, m.
        plan: x, y of its pixel in the frame of the plan, m.
        off: distance of both, m.
        off_others: the same when the transform is that of the other pairs alone, m.
        chance: how likely it is to be as far off if it is right.
    """

    number: Number
    node: NodeId
    merged: tuple[Coordinate, Coordinate]
    plan: tuple[Coordinate, Coordinate]
    off: Amount
    off_others: Amount
    chance: Probability


@dataclass(frozen=True, slots=True)
class PlanPart:
    """A plan under one component of the merged map.

    Attributes:
        component: number of the component.
        plan_from_merged: takes coordinates of the component to those of the plan.
        metres_per_pixel: of the image: as given, or of the pairs.
        merged_from_image: six numbers a to f: x = a u + c v + e and y = b u + d v + f, m, of the pixel u, v.
        covariance: (4, 4) by rows, of x m, y m, heading rad and ln scale of the lower left corner in the
            component's frame, by the clicks and the map's shape.
        sigma: of a position on the plan amid the pairs, m.
        rms: of the pairs' distances, m.
        pairs: of this component.
        fitted_scale: m in a pixel by the pairs alone.
        scale_sigmas: by how many standard deviations that differs from the given one; 0 without one.
        doubts: what is probably wrong, one sentence each.
    """

    component: Number
    plan_from_merged: Pose2
    metres_per_pixel: PixelSize
    merged_from_image: tuple[float, float, float, float, float, float]
    covariance: Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)]
    sigma: Amount
    rms: Amount
    pairs: Annotated[tuple[FittedPair, ...], Meta(max_length=MAX_PAIRS)]
    fitted_scale: Amount
    scale_sigmas: Amount = 0.0
    doubts: Annotated[tuple[Words, ...], Meta(max_length=8)] = ()


@dataclass(frozen=True, slots=True)
class PlacedPlan:
    """A plan under a merged map.

    Attributes:
        name: of the plan.
        plan: what was given.
        parts: one for each component on which it lies; the one with most pairs first.
        reason: why it lies under none, or what is left out; may be empty.
    """

    name: Annotated[str, Meta(max_length=64)]
    plan: FloorPlan
    parts: Annotated[tuple[PlanPart, ...], Meta(max_length=MAX_PARTS)] = ()
    reason: Words = ""

    def part(self, component: int | None = None) -> PlanPart:
        """The plan under a component; under the one with most pairs if none is given.

        Raises:
            Refused: it does not lie there, with the reason.
        """
        for part in self.parts:
            if component is None or part.component == component:
                return part
        if not self.parts:
            raise Refused(f"plan {self.name} lies under no part of the map: {self.reason}")
        where = ", ".join(str(part.component) for part in self.parts)
        raise Refused(f"plan {self.name} does not lie under component {component}, but under {where}")

    def pose(self, component: int, merged_from_robot: Pose2) -> Pose2 | None:
        """A pose of the merged map in the coordinates of the plan; None where the plan does not lie."""
        for part in self.parts:
            if part.component == component:
                return part.plan_from_merged @ merged_from_robot
        return None


@dataclass(frozen=True, slots=True)
class PlacedPlans:
    """The plans of a map, by name."""

    plans: tuple[PlacedPlan, ...] = field(default=())

    def plan(self, name: str) -> PlacedPlan:
        """One of them.

        Raises:
            Refused: there is none of this name.
        """
        for placed in self.plans:
            if placed.name == name:
                return placed
        names = ", ".join(placed.name for placed in self.plans) or "none; add one with `mapweave plan add`"
        raise Refused(f"there is no plan {name!r}; there are: {names}")
