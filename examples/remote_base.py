"""A robot base behind two Zenoh keys (docs/wire.md). Needs only eclipse-zenoh and msgpack."""

import struct
import sys
import time

import msgpack
import zenoh

ROOT, WIDTH, HEIGHT = "mapweave/1/demo/robot/r0", 320, 240
CAMERA = struct.pack("<HH6d", WIDTH, HEIGHT, 277.0, 277.0, 160.0, 120.0, 0.3, 0.0)
BASE = {"v": 1, "camera": CAMERA, "distortion": [0.0] * 5, "radius": 0.16, "axle": 0.24, "wheel_noise": 0.02,
        "ranger_bearings": [], "ranger_reach": 0.0, "max_forward": 0.3, "max_turn": 0.8,
        "tick": 0.1}  # fmt: skip
last = (0, b"")


def step(query: zenoh.Query) -> None:
    global last
    asked = msgpack.unpackb(query.payload.to_bytes())
    if asked["q"] != last[0]:  # a repeated number requests the same answer again
        forward, turn = asked["c"]  # m/s and rad/s; stop if no step arrives for 0.5 s
        time.sleep(0.1)
        seen = {"v": 1, "t": time.time_ns(), "u": [0.1 * forward, 0.1 * turn], "r": [], "b": False,
                "s": [HEIGHT, WIDTH], "encoding": "raw", "i": bytes(WIDTH * HEIGHT)}  # fmt: skip
        last = (asked["q"], msgpack.packb(seen))
    query.reply(f"{ROOT}/step", last[1])


config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{sys.argv[1] if sys.argv[1:] else "tcp/127.0.0.1:7447"}"]')
with zenoh.open(config) as session:
    session.declare_queryable(f"{ROOT}/describe", lambda q: q.reply(f"{ROOT}/describe", msgpack.packb(BASE)))
    session.declare_queryable(f"{ROOT}/step", step)
    time.sleep(1e9)
