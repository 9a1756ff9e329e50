"""Draws the pictures of the tutorials: maps of synthetic robots, merged by the code that robots use.

python docs/site/pictures.py
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import page_picture

from mapweave.drawing.link_picture import draw_link
from mapweave.drawing.map_picture import MapPicture, draw_map
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.mapserver.map_files import map_file_of
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.offline_merge import merge_parts
from synthetic.world import World, room, take_map

FOLDER = Path(__file__).parent
SEED = 11


def walks(world: World, rng: np.random.Generator) -> dict[MapId, HybridMap]:
    """Two robots, each around one half of a hall; both drive up its middle."""
    maps = {}
    for name, side in (("r0", -1.0), ("r1", 1.0)):
        corners = np.array([[0.0, -1.6], [0.0, 1.6], [3.6 * side, 1.6], [3.6 * side, -1.6], [0.0, -1.6]])
        stops = [
            Pose2(5.0 + x, 3.0 + y, float(np.arctan2(*(end - begin)[::-1])))
            for begin, end in pairwise(corners) for x, y in begin + np.outer(np.arange(4) / 4, end - begin)
        ]  # fmt: skip
        map_id = MapId(name, 1)
        nodes, edges = take_map(world, map_id, stops, rng)
        maps[map_id] = HybridMap([*map(NodePut, nodes), *map(EdgePut, edges)])
    return maps


def landmarks(merged: MergedMap) -> Array:
    """(N, 2) m."""
    nodes = [node for one in merged.maps.values() for node in one.nodes.values() if node.id in merged.poses]
    return np.concatenate(
        [merged.poses[n.id][1].mean.apply(n.points_in_robot[n.landmarks.has_depth, :2]) for n in nodes]
    )


def main() -> None:
    """Draw all of them."""
    rng = np.random.default_rng(SEED)
    maps = walks(room(0, 0, 10, 6, 900, rng), rng)
    one = merge_parts({MapId("r0", 1): maps[MapId("r0", 1)]}, ManualConstraints())
    both = merge_parts(maps, ManualConstraints())
    for name, merged, title in (("one-robot", one, "r0.1"), ("two-robots", both, "r0.1 and r1.1")):
        edges = list(HybridMap(map_file_of(merged).changes).edges.values())
        poses = {node: pose.mean for node, (_, pose) in merged.poses.items()}
        draw_map(MapPicture(title, poses, edges, landmarks=landmarks(merged)), FOLDER / f"{name}.png")
    link = next(link for link in both.links if not link.within)
    draw_link(explain_nodes(both, link.a, link.b), FOLDER / "link.png")
    page_picture.main()


if __name__ == "__main__":
    main()
