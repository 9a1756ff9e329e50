"""Our renderer beside PyBullet's on the same panels: the same picture, sooner, and one that does not shimmer.

`pytest -s tests/sim/test_rival.py` prints the figures of docs/decisions/renderer.md.
"""

import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.camera import WEBCAM
from mapweave.sim.physics import Physics
from mapweave.sim.renderer import Renderer
from mapweave.sim.world import PanelSet, World


class TinyRenderer:
    """The same panels in PyBullet, as quadrilaterals with the same textures."""

    def __init__(self, panels: PanelSet, camera: Camera, folder: Path) -> None:
        """Build them; textures have to pass through files."""
        self._physics = p = Physics()
        self._camera = camera
        quad = [[0, 1, 2], [0, 2, 3]]
        for k, (corner, along, down) in enumerate(zip(panels.corner, panels.along, panels.down, strict=True)):
            file = folder / f"{k}.png"
            cv2.imwrite(str(file), cv2.cvtColor(panels.textures[k].level(0, 0), cv2.COLOR_GRAY2BGR))
            normal = np.cross(down, along) / np.linalg.norm(np.cross(down, along))
            corners = [corner, corner + down, corner + along + down, corner + along]
            shape = p.createVisualShape(
                p.GEOM_MESH,
                vertices=[c.tolist() for c in corners],
                indices=np.ravel(quad).tolist(),
                uvs=[[0, 1], [0, 0], [1, 0], [1, 1]],
                normals=[normal.tolist()] * 4,
            )
            body = p.createMultiBody(baseVisualShapeIndex=shape)
            p.changeVisualShape(body, -1, textureUniqueId=p.loadTexture(str(file)))
        near, far = 0.03, 60.0
        c = camera
        self._projection = [
            2 * c.fx / c.width, 0, 0, 0, 0, 2 * c.fy / c.height, 0, 0,
            0, 0, -(far + near) / (far - near), -1, 0, 0, -2 * far * near / (far - near), 0,
        ]  # fmt: skip

    def render(self, pose: Pose2) -> np.ndarray:
        """(H, W) grey."""
        p, c = self._physics, self._camera
        eye = pose.apply(np.array([c.mount_forward, 0.0, c.mount_height]))
        ahead = pose.apply(np.array([c.mount_forward + 1.0, 0.0, c.mount_height]))
        view = p.computeViewMatrix(eye.tolist(), ahead.tolist(), [0, 0, 1])
        answer = p.getCameraImage(
            c.width, c.height, view, self._projection, renderer=p.ER_TINY_RENDERER, shadow=0,
            lightAmbientCoeff=1.0, lightDiffuseCoeff=0.0, lightSpecularCoeff=0.0,
            flags=p.ER_NO_SEGMENTATION_MASK,
        )  # fmt: skip
        return np.asarray(answer[2], np.uint8).reshape(c.height, c.width, 4)[..., 0]

    def close(self) -> None:
        """Let go."""
        self._physics.close()


@pytest.mark.slow
def test_same_picture_sooner_and_steadier(office: World, stand, tmp_path):
    """40 panels, 12 neighbouring places: pictures agree, and ours costs less and moves more smoothly."""
    start = office.start_poses(1, 4)[0]
    centres = np.array([panel.corner + panel.along / 2 for panel in office.panels])[:, :2]
    near = np.argsort(np.linalg.norm(centres - [start.x, start.y], axis=1))
    upright = [k for k in near if office.panels[k].down[2] < 0][:40]
    panels = PanelSet.of([office.panels[k] for k in upright])
    own, theirs = Renderer(WEBCAM, 255), TinyRenderer(panels, WEBCAM, tmp_path)
    poses = [start @ Pose2(0.02 * k, 0.0, 0.01 * k + turn) for turn in (0.0, 2.0, 4.0) for k in range(4)]
    draw = {"ours": lambda pose: own.render(panels, *stand(pose)), "TinyRenderer": theirs.render}
    pictures: dict[str, list[Array]] = {}
    seconds: dict[str, float] = {}
    for name, render in draw.items():
        for pose in poses:
            render(pose)  # the first time, textures are painted and filtered
        begin = time.process_time()
        pictures[name] = [render(pose).astype(np.float64) for pose in poses]
        seconds[name] = (time.process_time() - begin) / len(poses)
    theirs.close()
    soft = {name: [cv2.GaussianBlur(x, (0, 0), 3.0) for x in p] for name, p in pictures.items()}
    alike = [np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in zip(*soft.values(), strict=True)]
    print("\ncorrelation of pictures:", " ".join(f"{x:.3f}" for x in alike))
    for name, p in pictures.items():
        print(f"{name}: {1000 * seconds[name]:.1f} ms, flow {flow_error(p):.2f} px")
    assert np.median(alike) > 0.97
    assert seconds["ours"] < seconds["TinyRenderer"]
    assert flow_error(pictures["ours"]) < flow_error(pictures["TinyRenderer"])


def flow_error(pictures: list[Array]) -> float:
    """Median px that Lucas-Kanade misses, going to the next of four pictures and back by another window."""
    misses = []
    neighbours = [pair for k in range(0, len(pictures), 4) for pair in pairwise(pictures[k : k + 4])]
    for before, after in neighbours:
        a, b = before.astype(np.uint8), after.astype(np.uint8)
        points = cv2.goodFeaturesToTrack(a, 120, 0.02, 7)
        there, result, _ = cv2.calcOpticalFlowPyrLK(a, b, points, None, winSize=(15, 15))
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, winSize=(11, 11))
        good = (result & found_back)[:, 0] == 1
        misses.append(np.linalg.norm((back - points)[good, 0], axis=1))
    return float(np.median(np.concatenate(misses)))
