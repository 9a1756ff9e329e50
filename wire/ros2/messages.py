"""ROS 2 messages as bytes (CDR) and back, and the hashes of their types, by `rosbags`."""

from functools import cache
from typing import Any

from mapweave.hybridmap.errors import InvalidMessage

DEFINITIONS = {
    "irobot_create_msgs/msg/WheelTicks": "std_msgs/Header header\nint32 ticks_left\nint32 ticks_right\n",
    "irobot_create_msgs/msg/KidnapStatus": "std_msgs/Header header\nbool is_kidnapped\n",
    "irobot_create_msgs/msg/HazardDetection": (
        "uint8 BACKUP_LIMIT=0\nuint8 BUMP=1\nuint8 CLIFF=2\nuint8 STALL=3\nuint8 WHEEL_DROP=4\n"
        "uint8 OBJECT_PROXIMITY=5\nstd_msgs/Header header\nuint8 type\n"
    ),
    "irobot_create_msgs/msg/HazardDetectionVector": (
        "std_msgs/Header header\nirobot_create_msgs/HazardDetection[] detections\n"
    ),
    "irobot_create_msgs/msg/IrIntensity": "std_msgs/Header header\nint16 value\n",
    "irobot_create_msgs/msg/IrIntensityVector": (
        "std_msgs/Header header\nirobot_create_msgs/IrIntensity[] readings\n"
    ),
    "foxglove_msgs/msg/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a\n",
    "foxglove_msgs/msg/Point2": "float64 x\nfloat64 y\n",
    "foxglove_msgs/msg/CircleAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nfloat64 diameter\n"
        "float64 thickness\nfoxglove_msgs/Color fill_color\nfoxglove_msgs/Color outline_color\n"
    ),
    "foxglove_msgs/msg/PointsAnnotation": (
        "builtin_interfaces/Time timestamp\nuint8 UNKNOWN=0\nuint8 POINTS=1\nuint8 LINE_LOOP=2\n"
        "uint8 LINE_STRIP=3\nuint8 LINE_LIST=4\nuint8 type\nfoxglove_msgs/Point2[] points\n"
        "foxglove_msgs/Color outline_color\nfoxglove_msgs/Color[] outline_colors\n"
        "foxglove_msgs/Color fill_color\nfloat64 thickness\n"
    ),
    "foxglove_msgs/msg/TextAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nstring text\n"
        "float64 font_size\nfoxglove_msgs/Color text_color\nfoxglove_msgs/Color background_color\n"
    ),
    "foxglove_msgs/msg/ImageAnnotations": (
        "foxglove_msgs/CircleAnnotation[] circles\nfoxglove_msgs/PointsAnnotation[] points\n"
        "foxglove_msgs/TextAnnotation[] texts\n"
    ),
}
"""Messages of the Create 3, and of Foxglove, that are no part of ROS 2."""


@cache
def _stores() -> tuple[Any, Any]:
    """The messages of Jazzy, which are those of Iron to Lyrical, and of Humble, whose Range is another."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    stores = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS2_HUMBLE)
    for store in stores:
        for kind, text in DEFINITIONS.items():
            store.register(get_types_from_msg(text, kind))
    return stores


def typestore() -> Any:
    """The messages of Jazzy and those of the Create 3, for readers and writers of bags."""
    return _stores()[0]


def type_hash(kind: str) -> str:
    """The hash of a type, as it stands in keys."""
    return str(_stores()[0].hash_rihs01(kind))


def make(kind: str, **fields: Any) -> Any:
    """Make a message."""
    return _stores()[0].types[kind](**fields)


def encode(message: Any) -> bytes:
    """Encode a message."""
    return bytes(_stores()[0].serialize_cdr(message, message.__msgtype__))


def decode(kind: str, data: bytes) -> Any:
    """Decode a message of a type.

    Raises:
        InvalidMessage: it is damaged, or of another type.
    """
    failure: Exception | None = None
    for store in _stores():
        try:
            return store.deserialize_cdr(data, kind)
        except Exception as error:  # noqa: BLE001 - the parser raises whatever damaged bytes lead it to
            failure = failure or error
    words = " ".join(str(failure).split()) or type(failure).__name__
    raise InvalidMessage(f"{len(data)} bytes are no {kind} ({words})")
