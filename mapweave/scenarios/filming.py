"""Film and live view of a trial: a frame whenever simulated time stops for long enough."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapweave.hybridmap.pose import Array
from mapweave.scenarios.film_frame import FilmFrame
from mapweave.scenarios.fleet import TrialFleet, TrialStage
from mapweave.scenarios.live import LiveFilm
from mapweave.scenarios.scenario_runner import ScenarioRunner
from mapweave.scenarios.webm_film import Film

FILM = "film.webm"
FRAMES_PER_SECOND = 10.0


@dataclass(frozen=True)
class FilmingOptions:
    """What is made of the pictures.

    Attributes:
        every: simulated seconds between two frames.
        film: whether to write a film.
        port: of the live view; None for none.
        say: takes a line for people.
    """

    every: float = 1.0
    film: bool = True
    port: int | None = None
    say: Callable[[str], None] = lambda line: None


@contextmanager
def filming(
    stage: TrialStage, options: FilmingOptions, fleet: TrialFleet, out: Path
) -> Iterator[Callable[[ScenarioRunner], None]]:
    """The function to call whenever simulated time stops.

    Raises:
        SettingsError: the port of the live view cannot be used.
    """
    if not options.film and options.port is None:
        yield lambda runner: None
        return
    with ExitStack() as stack:
        title = f"{stage.scenario.name}, seed {stage.seed}"
        film = stack.enter_context(Film(out / FILM, FRAMES_PER_SECOND)) if options.film else None
        live = None if options.port is None else stack.enter_context(LiveFilm(options.port, title))
        if live is not None:
            options.say(f"watch at {live.url}")
        scene = FilmFrame(fleet.control.plan(), stage.robots, title)
        places: dict[str, list[tuple[float, float, float]]] = {robot: [] for robot in stage.robots}
        due = 0.0

        def frame(runner: ScenarioRunner) -> None:
            nonlocal due
            if runner.now < due - 1e-6:
                return
            due = runner.now + options.every
            shot = fleet.control.snapshot()
            captions = {}
            for robot, report in runner.agents.items():
                captions[robot] = f"{report.status.nodes} nodes, {report.status.doing}"
                # A node is made about where the robot is: good enough for a dot in a film.
                while len(places[robot]) < report.status.nodes:
                    pose = shot.robots[robot]
                    places[robot].append((pose.x, pose.y, pose.heading))
            nodes: dict[str, Array] = {
                robot: np.array(poses).reshape(-1, 3) for robot, poses in places.items() if poses
            }
            drawn = scene.draw(shot, nodes, captions, runner.doing)
            if film is not None:
                film.add(drawn)
            if live is not None:
                live.show(drawn)

        yield frame
