"""A robot base behind two Zenoh keys (docs/wire.md). Needs eclipse-zenoh, msgpack, and a router that runs."""

import struct
import sys
import time

import msgpack
import zenoh

ROOT, ROUTER = "mapweave/1/demo/robot/r0", sys.argv[1] if sys.argv[1:] else "tcp/127.0.0.1:7447"
CAMERA = struct.pack("<HH6d", 320, 240, 277.0, 277.0, 160.0, 120.0, 0.3, 0.0)
BASE = {"v": 1, "camera": CAMERA, "radius": 0.16, "axle": 0.24, "max_forward": 0.3, "max_turn": 0.8}
last, SEEN = {"q": 0}, {"v": 1, "r": [], "b": False, "s": [240, 320], "encoding": "raw", "i": bytes(76_800)}


def step(query: zenoh.Query) -> None:
    if (asked := msgpack.unpackb(query.payload.to_bytes()))["q"] != last["q"]:  # else the same answer again
        time.sleep(0.1)  # it drives by asked["c"], m/s and rad/s; stop if no step arrives for 0.5 s
        last.update(q=asked["q"], new={"t": time.time_ns(), "u": [0.1 * speed for speed in asked["c"]]})
    query.reply(f"{ROOT}/step", msgpack.packb(SEEN | last["new"]))


try:
    session = zenoh.open(zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{ROUTER}"]}}}}'))
except zenoh.ZError:
    sys.exit(f"no router at {ROUTER}: start `mapweave server`, or give the router's address")
with session:
    session.declare_queryable(f"{ROOT}/describe", lambda q: q.reply(f"{ROOT}/describe", msgpack.packb(BASE)))
    session.declare_queryable(f"{ROOT}/step", step)
    time.sleep(1e9)
