"""Watch a running fleet: `python examples/watch_fleet.py [ENDPOINT [SECONDS]]`.

`mapweave server` and `mapweave agent` make one; `mapweave sim serve` gives the agents simulated robots.
"""

import sys
from pathlib import Path

import matplotlib as mpl

import mapweave

mpl.use("agg")  # a picture in a file; leave this out in a notebook

endpoint = sys.argv[1] if sys.argv[1:] else "tcp/127.0.0.1:7447"
seconds = float(sys.argv[2]) if sys.argv[2:] else 60.0
picture = Path("out/examples/fleet.png")

with mapweave.connect(endpoint) as fleet:
    for robot in fleet.status().robots:
        print(f"{robot.robot} is {'there' if robot.alive else 'gone'}, at {robot.merged_from_robot}")
    for event in fleet.events(seconds):
        match event:
            case mapweave.AgentStatus():
                print(f"{event.robot}: {event.status.doing} {event.status.detail}")
            case mapweave.MapEvent():
                print(f"{event.kind}: {event.words}")
            case mapweave.MapChanged():
                print(f"map: {event.summary}")
                fleet.refresh()
                if len(fleet.nodes):
                    picture.parent.mkdir(parents=True, exist_ok=True)
                    axes = fleet.plot()
                    axes.figure.savefig(picture)
                    axes.figure.clear()
                    print(f"{picture}: {len(fleet.nodes)} nodes")
