"""ROS 1 and ROS 2 bags (.bag, .mcap, .db3, or a bag's folder), read by `rosbags`, without ROS."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.recordings.bounded_decompression import limit_rosbags
from mapweave.agent.recordings.camera_info_check import doubts
from mapweave.agent.recordings.damaged_bag import DamagedBag, full_type, standard_messages
from mapweave.agent.recordings.geometry_file import LIMITS
from mapweave.agent.recordings.incomplete import CameraGiven, Incomplete, complete
from mapweave.agent.recordings.options import RecordingOptions
from mapweave.agent.recordings.pose_files import read_poses
from mapweave.agent.recordings.recording import (
    BagContents,
    BagTopic,
    Images,
    Recording,
    StampedPoses,
    names_of,
)
from mapweave.agent.recordings.wheel_data import WheelModel, wheels_of
from mapweave.agent.ros_messages.images import GreyImages
from mapweave.agent.ros_messages.values import (
    BASES,
    CAMERA_TYPE,
    IMAGE_TYPES,
    KIDNAP_TYPE,
    ODOMETRY_TYPE,
    TF_TYPE,
    FixedTransforms,
    Mount,
    camera_of,
    planar_pose_of,
    pose_of,
    stamp_of,
)
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import DeviceError, InvalidValue, MapweaveError
from mapweave.vision.lens import lens_of

SUFFIXES = {".bag", ".mcap", ".db3"}
POSE_TYPES = (
    ODOMETRY_TYPE,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
ODOMETRY_FRAME = "odom"
"""The frame in which a base drives, by REP 105."""
StampedRow = tuple[int, int, tuple[float, float, float]]
"""Stamp, ns, that of the header, 0 if there is none; x m, y m, heading rad."""
TRUTH = ("truth", "gt", "amcl", "mocap", "vicon")
"""Parts of names of topics that are never taken for odometry."""
RECTIFIED = "image_rect"
"""Beginning of names of topics whose images are without distortion, as image_proc names them."""
DEPTH = "depth"
"""Part of names of topics whose images show distances: taken only where there are no others."""


class Bag:
    """A bag that is open for reading.

    Attributes:
        path: of it.
        topics: of all its parts.
        damage: what cannot be read of it, a line each.
        wheels: how they err; None if it does not say.
    """

    def __init__(self, path: Path) -> None:
        """Open it. Of a file without an index, or that was cut off, what stands before the damage is read.

        Raises:
            DeviceError: nothing of it can be read.
        """
        self.path, self.damage = path, list[str]()
        self.wheels: WheelModel | None = None
        self._parts = [part for each in parts_of(path) for part in self._opened(each)]
        if not self._parts:
            raise DeviceError((self.damage or [f"{path}: no bag in it"])[0])
        counts: dict[tuple[str, str], int] = {}
        for part in self._parts:
            for name, (kind, count) in part.topics.items():
                counts[name, kind] = counts.get((name, kind), 0) + count
        self.topics = tuple(BagTopic(name, kind, counts[name, kind]) for name, kind in sorted(counts))

    @property
    def contents(self) -> BagContents:
        """What is in it."""
        times = [time for part in self._parts for time in part.span_ns]
        return BagContents(self.topics, (max(times) - min(times)) * 1e-9 if times else 0.0)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Stamps, ns, and messages of a topic, in the order in which they were recorded.

        The stamp is the header's where it is set: when it was measured, not when it arrived. A message that
        cannot be decoded ends the topic, and is noted as damage.
        """
        count = 0
        for part in self._parts:
            try:
                for arrived, message in part.messages(topic):
                    count += 1
                    yield stamp_of(message) or arrived, message
            except Exception as error:  # noqa: BLE001  # parsers raise whatever a damaged file leads them to
                self.damaged(f"{self.path}: {topic} ends after {count} messages ({_line(error)})")
                return

    def damaged(self, line: str) -> None:
        """Note damage, once."""
        if line not in self.damage:
            self.damage.append(line)

    def _opened(self, path: Path) -> list[WholeBag | DamagedBag]:
        try:
            whole = WholeBag(self, path)
            self._take_wheels(path, whole.custom_data)
            return [whole]
        except Exception as error:  # noqa: BLE001  # as above
            reason = _line(error)
        parts: list[DamagedBag] = []
        for file in files_of(path):
            try:
                parts.append(DamagedBag(file))
            except (DeviceError, OSError) as error:
                self.damaged(f"{file}: not a bag that can be read ({_line(error)})")
        losses = [reason if part.loss is None else part.loss for part in parts]
        if any(losses):
            first = next(loss for loss in losses if loss)
            self.damaged(f"{path}: damaged or cut off ({first}); what comes before is used")
        elif not (parts or self.damage):
            self.damaged(f"{path}: not a bag that can be read ({reason})")
        return [*parts]

    def _take_wheels(self, path: Path, custom_data: object) -> None:
        try:
            self.wheels = self.wheels or wheels_of(custom_data)
        except ValueError as error:
            self.damaged(f"{path}: {error}; it is not used")


class WholeBag:
    """A bag as it should be, read by `rosbags`.

    Attributes:
        topics: by name: the type of its messages, and how many there are.
        span_ns: when the first message and the last were recorded; empty if there are none.
        custom_data: of its metadata.yaml, as it was read; None if there is none.
    """

    def __init__(self, owner: Bag, path: Path) -> None:
        """Open it; the file stays open as long as its owner is referenced.

        Raises:
            Exception: whatever a damaged file leads to.
        """
        from rosbags.highlevel import AnyReader

        limit_rosbags()
        ros1 = path.suffix == ".bag"
        self._is_sqlite = any(file.suffix.lower() == ".db3" for file in files_of(path))
        self._standard = standard_messages(ros1)
        # A bag of ROS 1 always has its own definitions.
        self._reader = AnyReader([path], default_typestore=None if ros1 else self._standard)
        self._reader.open()
        weakref.finalize(owner, self._reader.close)
        self.topics: dict[str, tuple[str, int]] = {}
        for connection in self._reader.connections:
            _, count = self.topics.get(connection.topic, ("", 0))
            kind = self._type_of(connection)
            self.topics[connection.topic] = kind, count + connection.msgcount
        begin, end = self._reader.start_time, self._reader.end_time
        self.span_ns = (begin, end) if self._reader.message_count else ()
        storage = getattr(self._reader.readers[0], "storage", None)
        self.custom_data: object = getattr(getattr(storage, "metadata", None), "custom", None)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Stamps, ns, and messages of a topic, in the order in which they were recorded.

        Raises:
            Exception: whatever a damaged file leads to.
        """
        connections = [c for c in self._reader.connections if c.topic == topic]
        if not connections:
            return
        for kind in {self._type_of(connection) for connection in connections}:
            self._check_fields(kind)
        for connection, arrived, data in self._reader.messages(connections):
            yield arrived, self._reader.deserialize(data, self._type_of(connection))

    def _type_of(self, connection: Any) -> str:
        kind: str = connection.msgtype
        return full_type(kind) if self._is_sqlite else kind

    def _check_fields(self, kind: str) -> None:
        """A bag has its own definitions of the types: they may lack what the standard has.

        Raises:
            DeviceError: a field is missing, or of another type.
        """
        checked, left = set[str](), [kind]
        while left:
            if (one := left.pop()) in checked or one not in self._standard.fielddefs:
                continue
            checked.add(one)
            given = dict(self._reader.typestore.fielddefs[one][1])
            for name, form in self._standard.fielddefs[one][1]:
                if given.get(name) != form:
                    raise DeviceError(f"in this bag, {one} has no field {name} as ROS defines it")
                left += _names_in(form)


def _names_in(form: Any) -> list[str]:
    """The types of messages in the type of a field, see `rosbags.typesys.base.Nodetype`."""
    if isinstance(form, str):
        return [form] if "/" in form else []
    return [name for part in form for name in _names_in(part)] if isinstance(form, tuple) else []


def parts_of(path: Path) -> list[Path]:
    """The bags of a recording: itself, or those in its folder, in their order.

    A bag's folder has a `metadata.yaml`; where the recorder was killed, only its files are there.
    """
    if not path.is_dir():
        return [path]
    folders = [path, *sorted((inside for inside in path.iterdir() if inside.is_dir()), key=_numbered)]
    bags = [[each] if (each / "metadata.yaml").exists() else files_of(each) for each in folders]
    return bags[0] or [bag for inside in bags[1:] for bag in inside]


def files_of(path: Path) -> list[Path]:
    """The file itself, or the bag files in a bag's folder, in the order in which they were recorded."""
    if not path.is_dir():
        return [path]
    return sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=_numbered)


def _numbered(path: Path) -> tuple[int, str]:
    """A key for sorting: walk_10 comes after walk_9."""
    return len(path.name), path.name


def bag(path: Path, options: RecordingOptions) -> Recording:
    """Open a bag: its images and its odometry, by the topics' types if no names are given.

    Raises:
        DeviceError: something is missing or wrong; one line says which topics there are.
    """
    opened = Bag(path)
    if options.image_topic is None and not _of(opened, IMAGE_TYPES):
        lacks = f"no images ({' or '.join(IMAGE_TYPES)})"
        has_odometry = options.odometry is not None or _odometry_topic(opened, options) is not None
        message = f"{path}: {lacks}; it has {names_of(opened.topics)}"
        raise Incomplete(message, None, (lacks,), has_odometry, opened.contents)
    image = _chosen(opened, options.image_topic, IMAGE_TYPES, "images")
    stamped = [(stamp, stamp_of(message)) for stamp, message in opened.messages(image.name)]
    if not stamped:
        raise DeviceError((opened.damage or [f"{path}: {image.name} has no images"])[-1])
    stamps, kept, left_out = _in_order(stamped, "image", image.name)
    notes = [f"images from {image.name}", *left_out]
    given = _camera(opened, image.name, options, notes)
    read, numbers = _sequential(opened, image.name), np.flatnonzero(kept)
    images = Images(stamps[kept], lambda k: read(int(numbers[k])))
    kind = f"bag ({path.suffix.lstrip('.') or 'folder'})"
    odometry = None
    if options.odometry is not None:
        odometry = read_poses(options.odometry)
    elif (topic := _odometry_topic(opened, options)) is not None:
        notes.append(f"odometry from {topic.name}")
        odometry = _poses(opened, topic.name)
    elif transforms := _odometry_transforms(opened):
        name, rows = transforms
        notes.append(f"odometry from {name}")
        odometry = _poses_of(opened, name, rows)
    found, lost = opened.contents, tuple(opened.damage)
    whole = complete(path, kind, given, images, odometry, tuple(notes), lost, found)
    kidnapped = _kidnapped(opened, whole.stamps_ns)
    begins = int(np.diff(kidnapped, prepend=False)[kidnapped].sum())
    lifted = (f"the robot was lifted {begins} times",) if begins else ()
    damage = (*opened.damage, *whole.damage[len(lost) :])
    notes = [*whole.notes, *lifted]
    return replace(whole, kidnapped=kidnapped, notes=tuple(notes), damage=damage, wheels=opened.wheels)


def _of(opened: Bag, kinds: Sequence[str]) -> list[BagTopic]:
    """The topics of these types that have messages."""
    return [topic for topic in opened.topics if topic.kind in kinds and topic.count]


def _chosen(opened: Bag, wanted: str | None, kinds: Sequence[str], what: str) -> BagTopic:
    """The topic that is wanted, else the one of the right type with most messages; there must be one."""
    fitting = _of(opened, kinds)
    if wanted is None:
        fitting = [topic for topic in fitting if DEPTH not in topic.name.lower()] or fitting
    else:
        for topic in opened.topics:
            if topic.name == wanted:
                if topic not in fitting:
                    kind = f"{counted(topic.count, 'message')} of {topic.kind}"
                    raise DeviceError(f"{opened.path}: {wanted} has {kind}; {what} are {' or '.join(kinds)}")
                return topic
        raise DeviceError(f"{opened.path}: no topic {wanted}; it has {names_of(opened.topics)}")
    most = max(topic.count for topic in fitting)
    # Raw and compressed forms of one camera have as many messages: the first name decides.
    return next(topic for topic in fitting if topic.count == most)


def _odometry_topic(opened: Bag, options: RecordingOptions) -> BagTopic | None:
    if options.odometry_topic is not None:
        return _chosen(opened, options.odometry_topic, POSE_TYPES, "poses")
    fitting = _of(opened, (ODOMETRY_TYPE,))
    fitting = [topic for topic in fitting if not any(word in topic.name.lower() for word in TRUTH)]
    if not fitting:
        return None
    # Filtered odometry may hold other sensors' errors; the wheels' own is what the filters here expect.
    return min(fitting, key=lambda topic: ("filter" in topic.name.lower(), -topic.count, topic.name))


def _odometry_transforms(opened: Bag) -> tuple[str, list[StampedRow]] | None:
    """What a base without a topic of odometry says by tf: the most transforms from odom to the base."""
    found: dict[str, list[StampedRow]] = {}
    for topic in _of(opened, (TF_TYPE,)):
        for arrived, message in () if "static" in topic.name else opened.messages(topic.name):
            for one in message.transforms:
                parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
                if parent.rpartition("/")[2] == ODOMETRY_FRAME and child.rpartition("/")[2] in BASES:
                    rows = found.setdefault(f"{topic.name}, {parent} to {child}", [])
                    rows.append((stamp_of(one) or arrived, stamp_of(one), planar_pose_of(one.transform)))
    return max(found.items(), key=lambda item: len(item[1]), default=None)


def _poses(opened: Bag, topic: str) -> StampedPoses:
    rows = [(stamp, stamp_of(message), pose_of(message)) for stamp, message in opened.messages(topic)]
    return _poses_of(opened, topic, rows)


def _poses_of(opened: Bag, topic: str, rows: list[StampedRow]) -> StampedPoses:
    poses = np.array([row[2] for row in rows]).reshape(-1, 3)
    good = np.isfinite(poses).all(axis=1)
    if not good.all():
        first = int(good.argmin())
        wrong = "has no orientation" if np.isfinite(poses[first, :2]).all() else "is not finite"
        opened.damaged(f"{opened.path}: pose {first} of {topic} {wrong}; what comes before is used")
        rows, poses = rows[:first], poses[:first]
    stamps, kept, notes = _in_order([row[:2] for row in rows], "pose", topic)
    if kept.sum() < 2:
        why = f" ({opened.damage[-1]})" if opened.damage else ""
        raise DeviceError(f"{opened.path}: {topic} has {int(kept.sum())} poses; there must be two{why}")
    return StampedPoses(stamps[kept], poses[kept], notes=notes)


def _in_order(
    stamped: list[tuple[int, int]], what: str, topic: str
) -> tuple[NDArray[np.int64], NDArray[np.bool_], tuple[str, ...]]:
    """Which messages follow all before them.

    Args:
        stamped: stamps, ns, and that in the header: 0 where the stamp is when the message was recorded.
        what: one of them is.
        topic: of them.

    Returns:
        (N,) stamps, (N,) which are kept, and what is left out, in a line; none if nothing is.
    """
    stamps = np.array([stamp for stamp, _ in stamped], np.int64)
    headers = np.array([header for _, header in stamped], np.int64)
    # A simulator's first messages may have none: the others' clock is not the recorder's.
    own = (headers == stamps) | ~headers.any()
    kept = own
    # A stamp that lies ahead by damage hides what follows it; nothing goes back in time.
    known = np.where(kept, stamps, np.iinfo(np.int64).min)
    kept = kept & np.append(True, known[1:] > np.maximum.accumulate(known)[:-1])[: len(stamps)]
    without = int((~own).sum())
    back = int((~kept).sum()) - without
    goes = "goes back in time or repeats a stamp" if back == 1 else "go back in time or repeat a stamp"
    has = "has" if without == 1 else "have"
    lines = [f"{counted(back, what)} of {topic} {goes}: left out"] if back else []
    lines += [f"{counted(without, what)} of {topic} {has} no stamp: left out"] if without else []
    return stamps, kept, tuple(lines)


def _kidnapped(opened: Bag, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) whether the robot was lifted at an image, or shortly before it and at no image.

    A base says it when it changes, or at a rate of its own: it holds until the next message.
    """
    kidnapped = np.zeros(len(stamps_ns), np.bool_)
    for topic in opened.topics:
        if topic.kind != KIDNAP_TYPE:
            continue
        said = [(stamp, bool(message.is_kidnapped)) for stamp, message in opened.messages(topic.name)]
        for (begin, lifted), (end, _) in pairwise([*said, (stamps_ns[-1] + 1, False)]):
            if lifted:
                first, last = np.searchsorted(stamps_ns, (begin, end))
                kidnapped[first : max(last, first + 1)] = True
    return kidnapped


def _camera(opened: Bag, image: str, options: RecordingOptions, notes: list[str]) -> CameraGiven:
    if options.camera is not None:
        return options.camera_of(None)
    infos = _of(opened, (CAMERA_TYPE,))
    if options.camera_info_topic is not None:
        infos = [_chosen(opened, options.camera_info_topic, (CAMERA_TYPE,), "cameras")]
    near = [
        topic for topic in infos if _namespace(topic.name) == _namespace(image.removesuffix("/compressed"))
    ]
    if not (near or len(infos) == 1):
        other = " or --camera-info-topic TOPIC" if infos else ""
        return CameraGiven(None, f"no camera_info beside {image}; give --camera FILE (a camera.toml){other}")
    info = (near or infos)[0]
    _, message = next(opened.messages(info.name), (0, None))
    if message is None:
        raise DeviceError((opened.damage or [f"{opened.path}: {info.name} has no message"])[-1])
    # Its driver has removed the distortion: D and K are those of the images before (REP 104).
    rectified = image.removesuffix("/compressed").rpartition("/")[2].startswith(RECTIFIED)
    matrix = "p" if rectified else "k"
    # Drivers without calibration leave it zero; ROS 1 writes it in capitals.
    if not np.any(getattr(message, matrix, getattr(message, matrix.upper(), ()))):
        zero = f"{info.name} has no calibration: its {matrix.upper()} is zero"
        return CameraGiven(None, f"{zero}; give --camera FILE (a camera.toml)")
    try:
        camera, model, coefficients = camera_of(message, rectified)
        mount = _mount(opened, str(message.header.frame_id))
        if mount is not None:
            camera = replace(camera, mount_height=mount.up, mount_forward=mount.forward)
        given = lens_of(camera, model, coefficients)
    except (DeviceError, InvalidValue) as error:
        raise DeviceError(f"{opened.path}: {info.name}: {error}") from None
    high = mount is not None and mount.up >= LIMITS["height"][0]
    if mount is not None:
        notes.append(f"camera {mount.forward:.2f} m ahead of the axle and {mount.up:.2f} m high, by tf")
        if not high and options.camera_height is None:
            notes.append("a camera is above the floor: tf does not say how high")
    notes += doubts(message, mount, rectified)
    return options.camera_of(given, high)


def _namespace(topic: str) -> str:
    return topic.rsplit("/", 1)[0]


def _mount(opened: Bag, frame: str) -> Mount | None:
    """The mount of a camera, by the fixed transforms."""
    transforms = FixedTransforms()
    for topic in opened.topics:
        if topic.kind == TF_TYPE and "static" in topic.name:
            for _, message in opened.messages(topic.name):
                transforms.add(message)
    return transforms.camera(frame)


def _sequential(opened: Bag, topic: str) -> Callable[[int], NDArray[np.uint8]]:
    """Reads images in ascending order quickly; going back begins the bag again."""
    messages: Iterator[tuple[int, Any]] | None = None
    at, images = 0, GreyImages(topic)

    def read(k: int) -> NDArray[np.uint8]:
        nonlocal messages, at
        if messages is None or k < at:
            messages, at = opened.messages(topic), 0
        for _, message in messages:
            at += 1
            if at == k + 1:
                try:
                    return images.read(message)
                except MapweaveError as error:
                    raise DeviceError(f"{opened.path}: image {k} of {topic}: {error}") from None
        raise DeviceError(f"{opened.path}: {topic} has no image {k}")

    return read


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
