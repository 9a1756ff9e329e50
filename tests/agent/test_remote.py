"""The codec of bases behind the bus, and the driver's patience."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave import Camera, Command, Observation, Odometry, RobotDescription
from mapweave.agent.drivers.messages import (
    AGAIN,
    ENDED,
    StepRequest,
    decode_description,
    decode_observation,
    decode_step,
    encode_description,
    encode_observation,
    encode_step,
)
from mapweave.agent.drivers.remote import ASK_TIMEOUT, PATIENCE, RemoteRobot
from mapweave.hybridmap.errors import DeviceError, InvalidMessage, InvalidValue
from mapweave.processes import simulator
from mapweave.sim.robots import robot_setups
from mapweave.sim.worlds.catalog import make_world
from mapweave.vision.equidistant import Equidistant
from mapweave.wire.bus import Request
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from tests.waiting import eventually

DESCRIPTION = RobotDescription(
    camera=Camera(width=320, height=240, fx=277.1, fy=276.9, cx=159.4, cy=119.6, mount_height=0.3),
    distortion=(0.1, -0.2, 0.003, 0.0004, 0.5),
    ranger_bearings=(-0.5, 0.0, 0.5),
    ranger_reach=3.0,
)
LENS = Equidistant(115.0, 115.5, 158.7, 120.9, (-0.02, 0.004, -0.003, 0.0005))
FISHEYE = replace(DESCRIPTION, camera=LENS.ideal(320, 240, 0.3), distortion=LENS)
KEYS = Keys("test")


def an_observation(image: np.ndarray[Any, np.dtype[np.uint8]] | None = None) -> Observation:
    return Observation(12_300_000_000, Odometry(0.03, -0.01), image, np.array([0.5, 3.0, 0.25]), True)


def same(a: Observation, b: Observation) -> bool:
    images = (a.image is None and b.image is None) or (
        a.image is not None and b.image is not None and np.array_equal(a.image, b.image)
    )
    rest = (a.stamp_ns, a.odometry, a.bumped, a.kidnapped) == (b.stamp_ns, b.odometry, b.bumped, b.kidnapped)
    return images and rest and np.array_equal(a.proximity, b.proximity)


def changed(data: bytes, **fields: object) -> bytes:
    message: bytes = msgpack.packb({**msgpack.unpackb(data), **fields})
    return message


reals = st.floats(-1e3, 1e3)


@given(
    st.integers(0, 2**63 - 1),
    st.tuples(st.floats(-10, 10), st.floats(-20, 20)),
    st.one_of(st.none(), st.tuples(st.integers(1, 40), st.integers(1, 40))),
    st.lists(st.floats(0, 1e4), max_size=32),
    st.booleans(),
    st.booleans(),
    st.randoms(use_true_random=False),
)
def test_an_observation_survives_exactly(stamp, odometry, shape, proximity, bumped, kidnapped, random):
    image = None
    if shape is not None:
        image = np.frombuffer(random.randbytes(shape[0] * shape[1]), np.uint8).reshape(shape)
    given_ = Observation(stamp, Odometry(*odometry), image, np.array(proximity), bumped, kidnapped=kidnapped)
    assert same(decode_observation(encode_observation(given_)), given_)


@given(st.integers(1, 2**53), reals, reals)
def test_a_step_survives_exactly(sequence: int, forward: float, turn: float):
    step = StepRequest(sequence, Command(forward, turn))
    assert decode_step(encode_step(step)) == step


def test_a_description_survives_exactly():
    for description in (DESCRIPTION, FISHEYE):
        assert decode_description(encode_description(description)) == description


def test_a_sliced_image_is_sent_correctly():
    image = np.arange(100, dtype=np.uint8).reshape(10, 10)[::2, ::3]
    decoded = decode_observation(encode_observation(an_observation(image))).image
    assert decoded is not None
    np.testing.assert_array_equal(decoded, image)


def test_a_decoded_image_works_with_opencv_though_it_is_read_only():
    rng = np.random.default_rng(5)
    image = cv2.resize(rng.integers(0, 256, (30, 40), dtype=np.uint8), (320, 240))
    decoded = decode_observation(encode_observation(an_observation(np.asarray(image, np.uint8)))).image
    assert decoded is not None
    assert not decoded.flags.writeable
    assert decoded.base is not None
    assert len(cv2.SIFT.create().detect(decoded, None)) == len(cv2.SIFT.create().detect(image, None)) > 10


@pytest.mark.parametrize(("encoding", "suffix", "error"), [("png", ".png", 0), ("jpeg", ".jpg", 3)])
def test_a_compressed_image_is_decoded(encoding: str, suffix: str, error: int):
    y, x = np.mgrid[:48, :64]
    image = (2 * x + y).astype(np.uint8)
    data = encode_observation(an_observation(image))
    small = changed(data, encoding=encoding, i=cv2.imencode(suffix, image)[1].tobytes())
    decoded = decode_observation(small).image
    assert decoded is not None
    assert np.abs(decoded.astype(int) - image).max() <= error
    with pytest.raises(InvalidMessage, match="64x47"):
        decode_observation(changed(small, s=[47, 64]))


@pytest.mark.parametrize("fields", [
    {"v": 99}, {"t": -1}, {"t": 2**63}, {"t": 1.0}, {"u": [0.0]}, {"u": [0.0, float("nan")]},
    {"u": [0.0, 0.0, 0.0]}, {"u": [float("inf"), 0.0]}, {"u": [10.1, 0.0]}, {"u": [0.0, -20.1]},
    {"r": [-0.1]}, {"r": [float("nan")]}, {"r": [0.0] * 257}, {"r": "far"}, {"b": 1}, {"s": [10, 11]},
    {"s": [10]}, {"s": [0, 0]}, {"s": [10, 10, 1]}, {"s": [-10, -10]}, {"i": b"x" * 99}, {"i": "text"},
    {"encoding": "tiff"}, {"encoding": "png"}, {"encoding": "jpeg"}, {"encoding": "png", "i": b""},
    {"encoding": 1},
])  # fmt: skip
def test_a_wrong_observation_is_refused(fields: dict[str, object]):
    data = encode_observation(an_observation(np.zeros((10, 10), np.uint8)))
    decode_observation(changed(data))
    with pytest.raises(InvalidMessage):
        decode_observation(changed(data, **fields))


@pytest.mark.parametrize("fields", [
    {"camera": b""}, {"distortion": [0.0] * 4}, {"radius": 0.0}, {"radius": float("nan")}, {"axle": -1.0},
    {"wheel_noise": 2.0}, {"ranger_bearings": [9.0]}, {"max_forward": -0.1}, {"max_turn": float("inf")},
    {"tick": 0.0}, {"tick": "soon"},
])  # fmt: skip
def test_a_wrong_description_is_refused(fields: dict[str, object]):
    with pytest.raises(InvalidMessage):
        decode_description(changed(encode_description(DESCRIPTION), **fields))


@pytest.mark.parametrize("fields", [{"q": 0}, {"q": 1.5}, {"c": [0.0]}, {"c": [0.0, float("nan")]}])
def test_a_wrong_step_is_refused(fields: dict[str, object]):
    with pytest.raises(InvalidMessage):
        decode_step(changed(encode_step(StepRequest(1, Command())), **fields))


MESSAGES: list[tuple[bytes, Callable[[bytes], object]]] = [
    (encode_observation(an_observation(np.zeros((4, 4), np.uint8))), decode_observation),
    (encode_description(DESCRIPTION), decode_description),
    (encode_description(FISHEYE), decode_description),
    (encode_step(StepRequest(7, Command(0.1, 0.2))), decode_step),
]


@settings(max_examples=100)
@given(st.sampled_from(MESSAGES), st.data())
def test_damaged_bytes_decode_or_are_refused_but_never_fail_otherwise(
    message: tuple[bytes, Callable[[bytes], object]], data: st.DataObject
):
    encoded, decode = message
    damaged = bytearray(encoded)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(damaged)))
    for attempt in (bytes(damaged), bytes(damaged[:cut])):
        try:
            decode(attempt)
        except InvalidMessage as error:
            assert "\n" not in str(error)


def test_an_image_of_another_type_is_not_sent():
    with pytest.raises(InvalidValue, match="uint8"):
        encode_observation(an_observation(np.zeros((4, 4, 3), np.uint8)))


class Body:
    """A body on its own bus whose answers the test chooses."""

    def __init__(self, hub: MemoryHub) -> None:
        self.bus = MemoryBus(hub)
        self.steps: list[StepRequest] = []
        self.answers: list[Callable[[Request], None]] = []
        self.bus.serve(KEYS.robot_describe("r0"), lambda r: r.reply(encode_description(DESCRIPTION)))
        self.bus.serve(KEYS.robot_step("r0"), self._step)

    def _step(self, request: Request) -> None:
        self.steps.append(decode_step(request.payload))
        answer = self.answers.pop(0) if self.answers else reply
        answer(request)


def reply(request: Request) -> None:
    request.reply(encode_observation(an_observation()))


def silence(request: Request) -> None:
    del request


@pytest.fixture
def body(hub: MemoryHub) -> Body:
    return Body(hub)


@pytest.fixture
def bus(hub: MemoryHub) -> MemoryBus:
    return MemoryBus(hub)


def test_commands_are_clipped_and_travel_with_the_next_step(body: Body, bus: MemoryBus):
    robot = RemoteRobot(bus, "test", "r0")
    assert robot.describe() == DESCRIPTION
    observation = robot.sense()
    assert observation is not None
    assert same(observation, an_observation())
    assert robot.act(Command(9.0, -9.0)) == Command(DESCRIPTION.max_forward, -DESCRIPTION.max_turn)
    robot.sense()
    assert robot.act(Command(-0.1, 0.2)) == Command(-0.1, 0.2)
    robot.sense()
    limits = Command(DESCRIPTION.max_forward, -DESCRIPTION.max_turn)
    assert body.steps == [
        StepRequest(1, Command()),
        StepRequest(2, limits),
        StepRequest(3, Command(-0.1, 0.2)),
    ]
    with pytest.raises(InvalidValue, match="finite"):
        robot.act(Command(float("nan"), 0.0))


def test_silence_and_a_busy_bus_are_asked_again_under_the_same_number(
    body: Body, bus: MemoryBus, monkeypatch
):
    monkeypatch.setattr("mapweave.agent.drivers.remote.ASK_TIMEOUT", 0.05)
    body.answers = [reply, silence, lambda r: r.refuse(f"too busy, {AGAIN}"), reply]
    robot = RemoteRobot(bus, "test", "r0")
    assert robot.sense() is not None
    assert robot.sense() is not None
    assert [step.sequence for step in body.steps] == [1, 2, 2, 2]


def test_a_step_that_failed_is_asked_again_under_its_own_number(body: Body, bus: MemoryBus):
    body.answers = [lambda r: r.refuse("broken wheel"), reply]
    robot = RemoteRobot(bus, "test", "r0")
    with pytest.raises(DeviceError, match="robot/r0/step: refused: broken wheel"):
        robot.sense()
    assert robot.sense() is not None
    assert [step.sequence for step in body.steps] == [1, 1]


def reported(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.endswith("drivers.remote")]


def test_a_base_that_vanishes_is_reported_and_stands_when_it_is_back(
    hub: MemoryHub, body: Body, bus: MemoryBus, monkeypatch, caplog
):
    monkeypatch.setattr("mapweave.agent.drivers.remote.ASK_TIMEOUT", 0.2)
    robot = RemoteRobot(bus, "test", "r0")
    robot.sense()
    robot.act(Command(0.1, 0.0))
    body.bus.close()
    seen: list[Observation | None] = []
    waiting = threading.Thread(target=lambda: seen.append(robot.sense()))
    waiting.start()
    eventually(lambda: reported(caplog))
    assert reported(caplog) == [
        f"{KEYS.robot_step('r0')}: the base is gone, start it again; the agent waits up to 90 s"
    ]
    again = Body(hub)
    waiting.join()
    assert seen != [None]
    assert again.steps[0] == StepRequest(2, Command())
    assert reported(caplog)[1:] == [f"{KEYS.robot_step('r0')}: the base answers"]
    again.bus.close()


def test_a_slow_simulation_is_not_taken_for_a_base_that_is_gone(
    body: Body, bus: MemoryBus, monkeypatch, caplog
):
    monkeypatch.setattr("mapweave.agent.drivers.remote.ASK_TIMEOUT", 0.05)
    robot = RemoteRobot(bus, "test", "r0")
    robot.sense()
    robot.act(Command(0.1, 0.0))
    body.answers = [silence, silence, silence, reply]
    assert robot.sense() is not None
    assert [step.command for step in body.steps[1:]] == [Command(0.1, 0.0)] * 4
    assert [line.partition("; ")[0] for line in reported(caplog)] == [
        f"{KEYS.robot_step('r0')}: no answer from the base (a simulated one waits for the agents of all its "
        "robots)",
        f"{KEYS.robot_step('r0')}: the base answers",
    ]


def test_the_end_of_the_simulation_is_no_failure(body: Body, bus: MemoryBus):
    body.answers = [lambda r: r.refuse(ENDED)]
    assert RemoteRobot(bus, "test", "r0").sense() is None


def test_a_broken_answer_is_a_device_error(body: Body, bus: MemoryBus):
    body.answers = [lambda r: r.reply(b"\x80")] * 2
    with pytest.raises(DeviceError, match="robot/r0/step: observation: Object missing required field `v`"):
        RemoteRobot(bus, "test", "r0").sense()


def wrong_image(request: Request) -> None:
    request.reply(encode_observation(an_observation(np.zeros((1, 1), np.uint8))))


def far_away(request: Request) -> None:
    request.reply(changed(encode_observation(an_observation()), u=[1e4, 0.0]))


@pytest.mark.parametrize(("answer", "reason"), [
    (wrong_image, "an image of 1x1 px from a camera described as 320x240 px"),
    (far_away, "odometry of 10000 m and 0 rad in one step"),
])  # fmt: skip
def test_an_impossible_observation_is_retried_once_then_refused_in_one_line(
    body: Body, bus: MemoryBus, answer: Callable[[Request], None], reason: str
):
    robot = RemoteRobot(bus, "test", "r0")
    body.answers = [answer, reply]
    observation = robot.sense()
    assert observation is not None
    assert same(observation, an_observation())
    body.answers = [answer, answer]
    with pytest.raises(DeviceError, match=reason) as error:
        robot.sense()
    assert "\n" not in str(error.value)
    assert [step.sequence for step in body.steps] == [1, 1, 2, 2]


def test_a_base_that_is_there_and_silent_is_not_said_to_be_missing(body: Body, bus: MemoryBus):
    """A simulated one waits for the agents of its other robots. Before, a person was sent to start it."""
    robot = RemoteRobot(bus, "test", "r0", patience=0.2)
    robot.describe()
    body.answers = [silence] * 9
    with pytest.raises(DeviceError, match=r"robot/r0/step: no answer for .*waits for the agents of all its"):
        robot.sense()


def test_a_missing_base_is_reported_in_one_line(bus: MemoryBus):
    begin = time.monotonic()
    with pytest.raises(DeviceError, match=r"robot/r0/describe: no answer .*mapweave sim") as error:
        RemoteRobot(bus, "test", "r0", patience=0.2).describe()
    assert 0.2 <= time.monotonic() - begin < 20
    assert "\n" not in str(error.value)


def test_stopping_while_waiting_is_not_reported_as_the_end_of_a_simulation(bus: MemoryBus):
    robot = RemoteRobot(bus, "test", "r0", patience=20.0)
    stop = threading.Timer(0.1, robot.close)
    stop.start()
    with pytest.raises(DeviceError, match="robot/r0/describe: stopped before its base has answered"):
        robot.describe()
    stop.join()


def test_a_simulated_base_that_waits_for_another_robot_is_not_given_up():
    assert simulator.PATIENCE + ASK_TIMEOUT < PATIENCE


def test_two_bases_of_one_name_are_refused(hub: MemoryHub, body: Body, bus: MemoryBus):
    second = Body(hub)
    with pytest.raises(DeviceError, match="2 bases answer"):
        RemoteRobot(bus, "test", "r0").sense()
    second.bus.close()


def test_a_base_that_starts_late_is_found(hub: MemoryHub, bus: MemoryBus):
    made: list[Body] = []
    late = threading.Timer(0.2, lambda: made.append(Body(hub)))
    late.start()
    assert RemoteRobot(bus, "test", "r0", patience=5.0).describe() == DESCRIPTION
    late.join()
    made[0].bus.close()


def test_a_closed_robot_senses_nothing(body: Body, bus: MemoryBus):
    robot = RemoteRobot(bus, "test", "r0")
    robot.close()
    assert robot.sense() is None
    assert body.steps == []


def test_a_second_simulator_ends_before_it_disturbs_the_first():
    """Its base would answer as well, and the agent that drives the first one ends then."""
    hub = MemoryHub()
    first, second = MemoryBus(hub), MemoryBus(hub)
    first.serve(KEYS.robot_describe("r1"), lambda request: request.reply(b"a description"))
    robots = robot_setups(["r0", "r1"])
    (stop := threading.Event()).set()
    with pytest.raises(
        DeviceError, match=r"^robot r1 has a base already: stop the other `mapweave sim serve`$"
    ):
        simulator.run_sim(second, KEYS.fleet, make_world("office", 1), robots, 1, stop)
