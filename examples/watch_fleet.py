"""Watch a fleet, as of `mapweave server --demo`: `python examples/watch_fleet.py [ENDPOINT [SECONDS]]`."""

import sys
from pathlib import Path

import mapweave.extras

mapweave.extras.exit_without("viz")
from matplotlib.figure import Figure

picture, doing = Path("out/examples/fleet.png"), dict[str, str]()
picture.parent.mkdir(parents=True, exist_ok=True)
try:
    with mapweave.connect(sys.argv[1] if sys.argv[1:] else "tcp/127.0.0.1:7447") as fleet:
        for robot in fleet.status().robots:
            print(f"{robot.robot} is {'there' if robot.alive else 'gone'}, at {robot.merged_from_robot}")
        for event in fleet.events(float(sys.argv[2]) if sys.argv[2:] else 60.0):
            match event:
                case mapweave.AgentStatus() if doing.get(event.robot) != event.status.doing:
                    doing[event.robot] = event.status.doing
                    print(f"{event.robot}: {event.status.doing} {event.status.detail}")
                case mapweave.MapEvent():
                    print(f"{event.kind}: {event.words}")
                case mapweave.MapChanged():
                    print(f"map: {event.summary}")
                    fleet.refresh()
                    if len(fleet.nodes):
                        fleet.plot(Figure().add_subplot()).figure.savefig(picture)
except mapweave.MapweaveError as error:
    sys.exit(str(error))
