"""What every format of a recording is read as: images with stamps, and the wheels' way between them."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.odometry_checks import bridged, contradiction
from mapweave.agent.recordings.wheel_data import WheelModel
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.errors import DeviceError
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.image_reduction import ImageSize, reduced_image, reduced_optics, reduced_size
from mapweave.vision.lens import NO_DISTORTION, Distortion, Lens

Stamps = NDArray[np.int64]

MUCH_RARER = 1.5
"""Poses that are so many times rarer than images are named."""
SILENCE_S, SILENCE_GAPS = 2.0, 10.0
"""A camera that gives no image for so long, s and median gaps, has stopped."""
FASTEST = 100.0
"""m/s, half of the time or more: no robot or car drives so fast, so the odometry is in another unit."""
LARGEST = 1e4
"""m or rad between two images; a larger motion is no measurement, and covariances overflow."""
ZERO, NEAR_ZERO = 1e-6, 0.1
"""m and rad: below the first a pose is that of a base that has just started; below the second, near it."""
LONG_GAP, SLOWEST = 10.0, 1e-3
"""s between two images, and m/s, half of the time or more: what 10 ms and 1 m/s seem to be where milliseconds
are taken for seconds. No robot's camera is quicker, and a robot that is so slow needs no image so rarely."""


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Attributes:
        name: of the topic.
        kind: type of its messages.
        count: how many there are.
    """

    name: str
    kind: str
    count: int


@dataclass(frozen=True)
class BagContents:
    """What is in a bag.

    Attributes:
        topics: by name.
        seconds: from the first message to the last, s.
    """

    topics: tuple[BagTopic, ...]
    seconds: float


@dataclass(frozen=True, eq=False)
class Recording:
    """A drive.

    Attributes:
        path: where it is.
        kind: of its format, in words.
        camera: of the images that `read` gives.
        distortion: of its lens.
        stamps_ns: (N,) of the images, ascending.
        read: gives an image by its number, (H, W) grey of the camera's size. Raises DeviceError.
        increments: (N, 2) way of the middle of the axle, m, and turn, rad, since the image before.
        notes: what was guessed or left out, a line each.
        damage: what cannot be read of it, a line each; what comes before is used.
        kidnapped: (N,) whether the robot was lifted since the image before; None if the format does not say.
        bag: what else is in it, if it is one.
        wheels: how they err; None if it does not say.
        timed: whether the stamps are the recording's, not assumed.
    """

    path: Path
    kind: str
    camera: Camera
    distortion: Distortion
    stamps_ns: Stamps
    read: Callable[[int], NDArray[np.uint8]]
    increments: Array
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    kidnapped: NDArray[np.bool_] | None = None
    bag: BagContents | None = None
    wheels: WheelModel | None = None
    timed: bool = True

    def __len__(self) -> int:
        """How many images there are."""
        return len(self.stamps_ns)


@dataclass(frozen=True, eq=False)
class Images:
    """The camera's side of a recording.

    Attributes:
        stamps_ns: (N,) ascending.
        read: gives an image by its number, (H, W) grey.
        damage: what follows and cannot be read, in one line; empty if nothing does.
        assumed: what stamps are assumed where there are none, in one line; empty if they are known.
    """

    stamps_ns: Stamps
    read: Callable[[int], NDArray[np.uint8]]
    damage: str = ""
    assumed: str = ""


@dataclass(frozen=True, eq=False)
class StampedPoses:
    """Odometry as poses with stamps of their own.

    Attributes:
        stamps_ns: (M,) ascending, by the images' clock.
        poses: (M, 3) x m, y m, heading rad, in a frame that drifts.
        damage: what follows and cannot be read, in one line; empty if nothing does.
        notes: what was sorted or left out, a line each.
    """

    stamps_ns: Stamps
    poses: Array
    damage: str = ""
    notes: tuple[str, ...] = ()


def stamps_of(path: Path, seconds: Iterable[float]) -> Stamps:
    """Stamps, ns.

    Args:
        path: of the file that they are in, for the error.
        seconds: since 1970, or since the start.

    Raises:
        DeviceError: one is no time.
    """
    try:
        return np.array([round(1e9 * time) for time in seconds], np.int64)
    except (ValueError, OverflowError):
        raise DeviceError(f"{path}: times are seconds since 1970 or since the start") from None


def increments_between(odometry: StampedPoses, stamps_ns: Stamps) -> tuple[NDArray[np.bool_], Array]:
    """What the wheels did between images.

    Poses are interpolated linearly. Images before the first pose or after the last one get none.

    Args:
        odometry: poses over time.
        stamps_ns: (N,) of images, ascending.

    Returns:
        (N,) which images have odometry, and (K, 2) forward m and turn rad of each of these since the one
        before; the first row is zero.

    Raises:
        DeviceError: the stamps do not overlap.
    """
    times = odometry.stamps_ns
    inside = (stamps_ns >= times[0]) & (stamps_ns <= times[-1]) if len(times) else np.zeros(0, np.bool_)
    if not inside.any():
        raise DeviceError(
            f"the images' stamps ({_span(stamps_ns)}) and the odometry's ({_span(times)}) do not overlap: "
            "they must be of one clock"
        )
    # Nanoseconds since 1970 exceed what a float64 holds exactly.
    at, known = stamps_ns[inside] - times[0], times - times[0]
    x, y, heading = odometry.poses.T
    poses = np.stack([np.interp(at, known, column) for column in (x, y, np.unwrap(heading))], axis=1)
    return inside, chords(poses)


def continued(odometry: StampedPoses) -> StampedPoses:
    """Poses that go on where a base that was started again has begun at zero again.

    Such a pose is zero, and the one before it is not near: no robot drives there. How it moved meanwhile is
    not known; it counts as standing.
    """
    poses = odometry.poses
    far = np.abs(poses[:-1]).sum(axis=1) > NEAR_ZERO
    resets = 1 + np.flatnonzero(far & (np.abs(poses[1:]).max(axis=1) < ZERO))
    if not len(resets):
        return odometry
    whole = poses.copy()
    for first, end in pairwise([*resets.tolist(), len(poses)]):
        base = Pose2(*whole[first - 1])
        whole[first:end] = [(base @ Pose2(*pose)).vector for pose in poses[first:end]]
    at = 1e-9 * float(odometry.stamps_ns[resets[0]] - odometry.stamps_ns[0])
    often = "once" if len(resets) == 1 else f"{len(resets)} times"
    note = (
        f"the odometry is set back to zero {often}, first {at:.1f} s after its first pose: it goes on there"
    )
    return replace(odometry, poses=whole, notes=(*odometry.notes, note))


def chords(poses: Array) -> Array:
    """(N, 3) poses to (N, 2) forward, m, and turn, rad, since the pose before; see `Odometry.motion`."""
    steps = np.diff(poses, axis=0)
    turns = (steps[:, 2] + math.pi) % math.tau - math.pi
    middle = poses[:-1, 2] + turns / 2
    forward = steps[:, 0] * np.cos(middle) + steps[:, 1] * np.sin(middle)
    return np.concatenate([np.zeros((1, 2)), np.stack([forward, turns], axis=1)])


def assembled(
    path: Path,
    kind: str,
    camera: Camera,
    distortion: Distortion,
    images: Images,
    odometry: StampedPoses | Array,
    notes: tuple[str, ...] = (),
    damage: tuple[str, ...] = (),
) -> Recording:
    """Put images and odometry together; large images are reduced.

    Args:
        path: where it is.
        kind: in words.
        camera: that took the images.
        distortion: of its lens.
        images: all of them.
        odometry: poses with stamps, or (N, 2) increments since the image before.
        notes: for people.
        damage: likewise, of what cannot be read.

    Raises:
        DeviceError: they do not fit together.
    """
    stamps, read = images.stamps_ns, images.read
    damage = (images.damage, *damage) if images.damage else damage
    notes = (images.assumed, *notes) if images.assumed else notes
    if len(stamps) < 2:
        raise DeviceError(f"{path}: {len(stamps)} images are no drive; there must be two or more")
    if (np.diff(stamps) <= 0).any():
        first = int((np.diff(stamps) <= 0).argmax()) + 1
        raise DeviceError(f"{path}: the images' stamps do not ascend: see image {first}, counted from 0")
    if isinstance(odometry, StampedPoses):
        odometry = continued(odometry)
        try:
            inside, increments = increments_between(odometry, stamps)
        except DeviceError as error:
            raise DeviceError(f"{path}: {error}") from None
        if wrong := contradiction(odometry.poses):
            raise DeviceError(f"{path}: poses of the odometry: {wrong}")
        damage = (*damage, odometry.damage) if odometry.damage else damage
        notes = (*notes, *odometry.notes)
        if not inside.all():
            notes = (*notes, f"{int((~inside).sum())} of {len(stamps)} images have no odometry: left out")
        numbers = np.flatnonzero(inside)
        stamps, whole = stamps[inside], read

        def read(k: int) -> NDArray[np.uint8]:
            return whole(int(numbers[k]))

        notes = (*notes, *_silence(stamps, odometry.stamps_ns), *_rare(stamps, odometry.stamps_ns))
    else:
        increments = odometry
    if len(increments) != len(stamps) or not np.isfinite(increments).all():
        raise DeviceError(f"{path}: {len(increments)} rows of odometry for {len(stamps)} images")
    whole_count, wrong = _plausible_rows(increments, stamps)
    if wrong and whole_count < 2:
        raise DeviceError(f"{path}: {wrong}")
    if wrong:
        damage = (*damage, f"{path}: {wrong}; what comes before is used")
        stamps, increments = stamps[:whole_count], increments[:whole_count]
    increments, jumps = bridged(increments, stamps)
    notes = (*notes, *jumps, *_milliseconds(increments, stamps))
    size = reduced_size(camera.width, camera.height)
    if size != (camera.width, camera.height):
        notes = (
            *notes,
            f"images are reduced from {camera.width}x{camera.height} to {size.width}x{size.height} px",
        )
    read = _reader(path, read, camera, size)
    camera, distortion = reduced_optics(camera, distortion, size)
    if isinstance(distortion, Equidistant):
        field = math.degrees(2.0 * camera.semi_aperture)
        notes = (*notes, f"fisheye images are rectified to {field:.0f} degrees")
        read, distortion = _rectified(read, Lens(camera, distortion)), NO_DISTORTION
    return Recording(
        path,
        kind,
        camera,
        distortion,
        stamps,
        read,
        increments,
        notes,
        damage,
        timed=not images.assumed,
    )


def _plausible_rows(increments: Array, stamps_ns: Stamps) -> tuple[int, str]:
    """How many rows of odometry come before one that no robot drives, and what is wrong; empty if nothing is.

    Args:
        increments: (N, 2) m and rad since the image before.
        stamps_ns: (N,) of the images.
    """
    moves = increments[1:, 0] != 0.0
    speeds = np.abs(increments[1:, 0])[moves] / (np.diff(stamps_ns)[moves] * 1e-9)
    if len(speeds) and float(np.median(speeds)) > FASTEST:
        return 0, (
            f"by its odometry the robot drives {float(np.median(speeds)):.3g} m/s: distances are in metres, "
            "and times in seconds"
        )
    far = np.flatnonzero((np.abs(increments) > LARGEST).any(axis=1))
    if not len(far):
        return len(increments), ""
    first = int(far[0])
    forward, turn = increments[first]
    return first, (
        f"odometry of image {first}, counted from 0, is no motion since the one before: {forward:.3g} m and "
        f"{turn:.3g} rad"
    )


def _rectified(read: Callable[[int], NDArray[np.uint8]], lens: Lens) -> Callable[[int], NDArray[np.uint8]]:
    return lambda k: lens.rectified(read(k))


def _rare(images_ns: Stamps, poses_ns: Stamps) -> list[str]:
    """A line if poses are rarer than images: between two of them a curve is a straight way."""
    if len(images_ns) < 2:
        return []
    image, pose = (float(np.median(np.diff(each))) * 1e-9 for each in (images_ns, poses_ns))
    if pose <= MUCH_RARER * image:
        return []
    return [f"odometry has a pose every {pose:.2g} s, images come every {image:.2g} s: straight ways between"]


def _silence(stamps_ns: Stamps, odometry_ns: Stamps) -> list[str]:
    """A line if the camera stops while the wheels go on."""
    gaps = np.diff(stamps_ns, append=max(stamps_ns[-1], odometry_ns[-1]))
    longest = int(gaps.argmax())
    if gaps[longest] <= max(SILENCE_S * 1e9, SILENCE_GAPS * float(np.median(gaps))):
        return []
    begin = (stamps_ns[longest] - stamps_ns[0]) / 1e9
    return [f"the camera is silent for {gaps[longest] / 1e9:.1f} s, {begin:.1f} s after its first image"]


def _milliseconds(increments: Array, stamps_ns: Stamps) -> list[str]:
    """A line if the times seem to be in milliseconds."""
    gaps, ways = np.diff(stamps_ns) * 1e-9, np.abs(increments[1:, 0])
    moves = ways > 0.0
    if not moves.any():
        return []
    gap, speed = float(np.median(gaps)), float(np.median(ways[moves] / gaps[moves]))
    if gap < LONG_GAP or speed > SLOWEST:
        return []
    return [
        f"the robot drives {1e3 * speed:.2g} mm/s, with an image every {gap:.3g} s: times must be in "
        "seconds; are these milliseconds?"
    ]


def names_of(topics: Iterable[BagTopic]) -> str:
    """Names and types of the topics that have messages."""
    return ", ".join(f"{topic.name} ({topic.kind})" for topic in topics if topic.count) or "no messages"


def _reader(
    path: Path, read: Callable[[int], NDArray[np.uint8]], camera: Camera, size: ImageSize
) -> Callable[[int], NDArray[np.uint8]]:
    def checked(k: int) -> NDArray[np.uint8]:
        image = read(k)
        if image.shape != (camera.height, camera.width):
            height, width = image.shape
            raise DeviceError(
                f"{path}: image {k} has {width}x{height} px, but the camera {camera.width}x{camera.height}; "
                "give --camera FILE, the camera.toml of images of this size"
            )
        return reduced_image(image, size)

    return checked


def _span(stamps_ns: Stamps) -> str:
    if not len(stamps_ns):
        return "none"
    return f"{stamps_ns[0] / 1e9:.3f} to {stamps_ns[-1] / 1e9:.3f} s"
