"""What the camera shows moves as the world's geometry says: flow is as good as on a real camera."""

import cv2
import numpy as np

from mapweave.agent.observation import Command
from mapweave.agent.vision.tracker import Tracker
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import PanelSet, World
from mapweave.vision.lens import Lens

PATCH = np.array([(dx, dy) for dx in (-9, 0, 9) for dy in (-9, 0, 9)], float)
"""Around a point, px: all of it must be on one surface, or what is tracked is no point of a wall."""


def test_tracks_follow_points_of_walls(office: World, caster, stand, monkeypatch):
    """Lucas-Kanade over half a second of driving and turning, against projections of the true points."""
    panels = PanelSet.of(office.panels)
    errors = []
    # Small windows: how a large patch grows on the way is Lucas-Kanade's trouble, not the picture's.
    monkeypatch.setattr("mapweave.agent.vision.tracker.WINDOW_PX", 9)
    with Simulation(office, ["r0"], 2) as simulation:
        camera = simulation.describe("r0").camera

        def cast(pixels: np.ndarray):
            return caster.cast(panels, camera, *stand(simulation.truth("r0")), pixels)

        for command in (Command(0.3, 0.0), Command(0.15, 0.4), Command(0.0, -0.5), Command(-0.2, 0.2)):
            description = simulation.describe("r0")
            tracker = Tracker(Lens(description.camera, description.distortion))
            image = simulation.step({"r0": command})["r0"].image
            pixels = cv2.goodFeaturesToTrack(image, 90, 0.02, 9)[:, 0].astype(float)
            pixels = pixels[camera.contains(pixels, 12.0)]
            surfaces = cast((pixels[:, None] + PATCH).reshape(-1, 2)).panel.reshape(len(pixels), -1)
            alone = (surfaces == surfaces[:, :1]).all(axis=1) & (surfaces[:, 0] >= 0)
            pixels, surfaces = pixels[alone], surfaces[alone, 0]
            points = cast(pixels).points
            tracker.track(image)
            tracker.add(np.arange(len(pixels)), pixels)
            for _ in range(5):
                tracker.track(simulation.step({"r0": command})["r0"].image)
            true = camera.project(simulation.truth("r0").inverse().apply(points))[tracker.ids]
            still_seen = cast(true).panel == surfaces[tracker.ids]
            errors.append((tracker.raw - true)[still_seen])
    off = np.linalg.norm(np.concatenate(errors), axis=1)
    assert len(off) > 80
    assert np.sqrt(np.mean(off**2)) < 0.5
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.1
