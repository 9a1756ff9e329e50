"""Where was a photo taken? `python examples/relocalize_photo.py [MAP.mapweave PHOTO.png CAMERA.toml]`.

Without a photo it takes one in the simulator, beside the place where a robot began its map.
"""

import math
import sys

import mapweave.extras

mapweave.extras.exit_without("sim", "server")
from drive_in_simulator import OFFICE, PLACES, drive

from mapweave.sim.simulation import Simulation

if sys.argv[1:]:
    answer = mapweave.open(sys.argv[1]).relocalize(sys.argv[2], sys.argv[3])
else:
    beside = mapweave.Pose2(0.15, -0.1, 0.1)  # in the frame of the map, which began at the robot's place
    with Simulation(OFFICE, ["visitor"], seed=1, poses=[PLACES["r0"] @ beside]) as simulation:
        seen, robot = simulation.observe("visitor"), simulation.describe("visitor")
    answer = mapweave.open(drive("r0")).relocalize(seen.image, robot.camera)
    print(f"really at {beside.x:+.3f} {beside.y:+.3f} m, {math.degrees(beside.heading):+.1f} deg")

print(f"{answer.certainty}: {answer.reason}")
for place in answer.candidates:
    print(f"near {place.node}: {place.inliers} landmarks agree, p = {place.probability:.3f}")
    if place.merged_from_robot is not None:
        x, y, heading = place.merged_from_robot.mean.vector
        print(f"at {x:+.3f} {y:+.3f} m, {math.degrees(heading):+.1f} deg")
