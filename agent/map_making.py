"""What a robot does whose mission is to map: explore, be carried, and find its own map again when it is lost.

`navigation/navigator.py` is what it does whose mission is a goal.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.camera_occupancy import CameraOccupancyGrid
from mapweave.agent.cautious_driving import lacks_rangers
from mapweave.agent.exploration.camera_exploration import CameraExploration
from mapweave.agent.exploration.carried_mapping import CarriedMapping
from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.exploration.random_exploration import RandomExploration
from mapweave.agent.global_localization.resumption import Resumption
from mapweave.agent.mapping.episode import EpisodeRequest
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mapping.node_retirement import Released, alone
from mapweave.agent.mission import Question, ServerAnswer
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.agent.ranger_monitor import not_exploring
from mapweave.agent.settings import AgentSettings
from mapweave.agent.submap_grid import SubmapGrid
from mapweave.hybridmap.change import ChangeBody, NodePut
from mapweave.hybridmap.ids import MapId
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift


class MapMaking:
    """The mapper, and who decides when to map what: the robot itself, or a person who moves it.

    Attributes:
        calibration: of the drive; what it finds out is used from the next node on.
        mapper: makes nodes and edges.
        floor: around the robot.
        sift: features of its images.
        losses: how often it was noticed that the robot is not where it took itself to be.
    """

    def __init__(
        self,
        map_id: MapId,
        calibration: OnlineCalibration,
        settings: AgentSettings,
        contents: Sequence[ChangeBody] = (),
        next_number: int = 1,
        released: Released = alone,
    ) -> None:
        """Begin a map, or go on with one; see `Pipeline`."""
        self.calibration = calibration
        calibration.switched()
        self._map_id = map_id
        self._settings = settings
        self._by_camera = lacks_rangers(calibration.description)
        self._use(calibration.description, calibration.lens)
        self.mapper = Mapper(map_id, self.description, settings, contents, next_number, self.lens, released)
        self.floor = self._new_floor()
        self._seen = set(self.mapper.map.nodes)
        self._changes: list[ChangeBody] = []
        self._explorer: Explorer | None = None
        self._carried = CarriedMapping(self.mapper)
        self._resumption: Resumption | None = None
        self._episodes = 0
        self._carried_to: Observation | None = None
        self.losses = 0

    @property
    def description(self) -> RobotDescription:
        """The robot's description, as it is calibrated."""
        return self._description

    @property
    def lens(self) -> Lens:
        """The lens of its camera, as it is calibrated."""
        return self._lens

    @property
    def located(self) -> bool:
        """Whether it is known where the robot is on its own map."""
        return self.mapper.started and not (self.mapper.astray or self.mapper.doubtful)

    @property
    def resuming(self) -> bool:
        """Whether the robot looks for a place of its own map."""
        return self._resumption is not None

    @property
    def lost(self) -> bool:
        """Whether it has given up looking."""
        return self._resumption is not None and self._resumption.lost

    def explore(self) -> None:
        """Let the robot decide from now on itself what to map, if it may; what was interrupted goes on."""
        if self._explorer is None and (not self._by_camera or self._settings.exploration.without_rangers):
            self._explorer = self._new_explorer()

    def end_search(self) -> None:
        """End the search for a place of the own map; if it is needed still, it begins from the start."""
        self._resumption = None

    def go_on(self) -> None:
        """Explore from where the robot is: a person has moved it."""
        if self._explorer is not None:
            self._explorer.restart()

    def lose_pose(self) -> None:
        """What was measured since the last node is void; nodes made before stay."""
        self.mapper.lose()
        self.restart()

    def restart(self) -> None:
        """The mapper has lost the robot's pose."""
        if self.mapper.map.nodes:
            self.go_on()
            return
        # The map may begin anywhere, and all that was found out on the way to it is void.
        self.floor = self._new_floor()
        if self._explorer is not None:
            self._explorer = self._new_explorer()

    def touch(self, heading: float) -> None:
        """A robot without rangers has touched something.

        Args:
            heading: where from the robot, rad to the left.
        """
        if isinstance(self.floor, CameraOccupancyGrid):
            self.floor.touch(self.mapper.map_from_robot.mean, heading)

    def keep_up(self, observation: Observation) -> None:
        """Pass the observation to the mapper; it may detect that the robot was carried off."""
        started = self.mapper.started
        self.mapper.step(observation)
        if started and not self.mapper.started:
            self.losses += 1
            self.restart()

    def step(
        self,
        observation: Observation,
        answers: tuple[ServerAnswer, ...],
        alone: bool,
        blind: bool,
        held: bool,
    ) -> tuple[Command, list[Question]]:
        """One tick of a mission to map.

        Args:
            observation: what the robot senses.
            answers: to questions of earlier ticks.
            alone: whether the robot drives itself; else a person moves it.
            blind: whether its sensors forbid it to drive.
            held: whether it must not move now, for this reason or another.

        Returns:
            A command, and questions to the fleet.
        """
        if self.mapper.astray:
            return self._resume(observation, alone, blind), []
        self._carried_to = None
        self.keep_up(observation)
        if self.mapper.doubtful or self.mapper.astray or blind:
            self.calibration.pause()
            return Command(), []
        self._use_calibrated()
        tracked, before = self.mapper.started, self._episodes
        command, questions = self._behave(observation, answers, alone, held)
        if observation.image is not None and tracked and self._episodes == before:
            # The tick that ends an episode takes long enough.
            self._calibrate(observation.image)
        return command, questions

    def _behave(
        self, observation: Observation, answers: tuple[ServerAnswer, ...], alone: bool, held: bool
    ) -> tuple[Command, list[Question]]:
        """What the robot does while it knows where it is."""
        pose = self.mapper.map_from_robot.mean
        if isinstance(self.floor, CameraOccupancyGrid):
            self.floor.drive(pose)
            self.floor.see_landmarks(pose, self.mapper.landmarks)
            observation = replace(observation, proximity=self.floor.readings(pose))
        else:
            self.floor.see(pose, observation.proximity)
        if self._explorer is None or not alone:
            self._carried_to = observation
            return self._act(self._carried, observation), []
        if held:
            return Command(), []
        self._explorer.see(observation, answers)
        return self._act(self._explorer, observation), self._explorer.questions

    def take_changes(self) -> tuple[ChangeBody, ...]:
        """What was changed in the map since the last call."""
        self._see_changes()
        changes, self._changes = tuple(self._changes), []
        return changes

    def finish(self) -> tuple[ChangeBody, ...]:
        """Make what is left of the last episode at once: no further tick is sure to come.

        The view from which a robot is mapping while it is carried becomes a node as it is known by now, if
        that is well enough: a recording ends anywhere.

        Returns:
            What was changed in the map since the last call of `take_changes`.
        """
        last, self._carried_to = self._carried_to, None
        if last is not None and self.located:
            self.mapper.finish(last)
        self.mapper.finish_pending()
        return self.take_changes()

    @property
    def explored(self) -> bool:
        """Whether the robot stands because there is nothing left to explore, at least for now."""
        return self._explorer is not None and self._explorer.idle and self.located

    def account(self, exploring: bool) -> tuple[str, str, bool]:
        """What it has made, for people.

        Args:
            exploring: whether the mission is to explore, and no person drives.

        Returns:
            What the robot does, details of it, and whether all is mapped.
        """
        if self.mapper.astray:
            doing = "lost" if self.lost else "looking for a place of its own map"
            return doing, "" if self._resumption is None else self._resumption.detail, False
        if self.mapper.doubtful:
            return "standing still", self.mapper.doubt, False
        if not exploring:
            return "mapping while carried", self._carried.detail, False
        if self._explorer is None:
            return "standing still", not_exploring(self._map_id.agent), False
        return str(self._explorer.phase), self._explorer.detail, self._explorer.finished

    def _act(self, behaviour: Explorer | CarriedMapping, observation: Observation) -> Command:
        """The behaviour's command for this tick; what it asks of the mapper before that is done at once.

        Only here do anchors become nodes. They leave with the step's changes; nodes of further views and loop
        closures follow in the next ticks.
        """
        while isinstance(move := behaviour.next_move(), EpisodeRequest):
            self.mapper.meet(move, observation)
            self._episodes += move is EpisodeRequest.FINISH
            self._see_changes()
        return move

    def _see_changes(self) -> None:
        """Take what was changed in the map; the floor that was seen is fixed to nodes, or seen by them.

        A node that is put again, known better or with other lengths, shows no more of it.
        """
        new = self.mapper.take_changes()
        self._changes += new
        for change in new:
            if isinstance(change, NodePut) and change.node.id not in self._seen:
                self._seen.add(change.node.id)
                self.floor.see_node(change.node)

    def _use_calibrated(self) -> None:
        """Go on with the geometry to which the mapper has changed."""
        calibration = self.calibration
        if calibration.pending is not None and self.mapper.description is calibration.pending[0]:
            calibration.switched()
            self._use(calibration.description, calibration.lens)

    def _calibrate(self, image: NDArray[np.uint8]) -> None:
        """Hold the tracks against the wheels; what they show is used from the next node on."""
        calibration = self.calibration
        calibration.watch(image, *self.mapper.tracks, self.mapper.turned)
        self.mapper.correct_turn(calibration.take_turn())
        self.mapper.doubt_lever(calibration.lever_error)
        if calibration.pending is not None:
            self.mapper.recalibrate(*calibration.pending)

    def _resume(self, observation: Observation, alone: bool, blind: bool) -> Command:
        """Find the robot on its own map; then map on from there."""
        if self._resumption is None:
            own_map, seed = self.mapper.map, self._settings.seed
            self._resumption = Resumption(self._description, self.sift, own_map, alone, seed)
        command = self._resumption.step(observation, blind)
        recognized, odom_from_robot = self._resumption.found, self._resumption.odom_from_robot
        if recognized is None:
            return command
        self.mapper.resume(observation, recognized.features, recognized.node, recognized.recognition)
        if isinstance(self.floor, SubmapGrid):
            self.floor.go_on_from(recognized.node)
        map_from_odom = self.mapper.map_from_robot.mean @ odom_from_robot.inverse()
        for odom_from_then, proximity in self._resumption.seen:
            self.floor.see(map_from_odom @ odom_from_then, proximity)
        self._resumption = None
        return Command()

    def _use(self, description: RobotDescription, lens: Lens) -> None:
        self._description, self._lens = description, lens
        self.sift = Sift(lens, self._settings.sift)

    def _new_floor(self) -> SubmapGrid | CameraOccupancyGrid:
        settings = self._settings.occupancy_grid
        if not self._by_camera:
            return SubmapGrid(self._description, settings)
        floor = CameraOccupancyGrid(self._description, settings)
        for node in self.mapper.map.nodes.values():
            floor.see_node(node)
        return floor

    def _new_explorer(self) -> Explorer:
        """It explores on the floor that it knows by rangers, or by its camera."""
        parts = self._map_id, self._description, self.mapper
        more = self._settings.exploration, self._settings.seed
        if isinstance(self.floor, CameraOccupancyGrid):
            return CameraExploration(*parts, self.floor, *more)
        kind = RandomExploration if self._settings.exploration.random else Explorer
        return kind(*parts, self.floor, *more)
