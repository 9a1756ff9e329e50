"""Motion primitives: stand, turn, drive on, ask. Each is a generator that yields a command a tick."""

import math
from collections.abc import Generator

from mapweave.agent.clearance import clearance
from mapweave.agent.mission import Question, ServerAnswer
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.pose import Pose2

Behaviour = Generator[Command, None, None]
NO_ANSWER = "no answer: is the map server running?"


class MotionPrimitives:
    """Connects behaviours, which are generators, to observations and answers, which come tick by tick.

    Attributes:
        odom_from_robot: pose by the wheels since the beginning.
        now: simulated or real time since then, s.
        way: driven since then, m, forward or backward.
        turned: turned since then, rad, either way.
        next_number: of the next question.
    """

    def __init__(self, description: RobotDescription, patience: int = 0, first: int = 1) -> None:
        """Take the robot's description.

        Args:
            description: of the robot.
            patience: ticks that an answer may take before the question counts as lost; unused by a robot
                that asks no questions.
            first: number of the first question.
        """
        self.odom_from_robot = Pose2()
        self.now = self.way = self.turned = 0.0
        self._description = description
        self._patience = patience
        self._observation: Observation | None = None
        self._answers: dict[int, ServerAnswer] = {}
        self._questions: list[Question] = []
        self.next_number = first

    @property
    def observation(self) -> Observation:
        """What the robot senses now."""
        assert self._observation is not None, "take_in comes first"
        return self._observation

    def take_in(self, observation: Observation, answers: tuple[ServerAnswer, ...]) -> None:
        """Begin a tick."""
        self._observation = observation
        self._answers.update({answer.number: answer for answer in answers})
        self._questions = []
        self.odom_from_robot = self.odom_from_robot @ observation.odometry.motion()
        self.now += self._description.tick
        self.way += abs(observation.odometry.forward)
        self.turned += abs(observation.odometry.turn)

    def questions(self) -> list[Question]:
        """What was asked in this tick."""
        return self._questions

    def number(self) -> int:
        """The number for the next question."""
        self.next_number += 1
        return self.next_number - 1

    def post(self, question: Question) -> None:
        """Ask without waiting; `answer` has the answer later."""
        self._questions.append(question)

    def answer(self, number: int) -> ServerAnswer | None:
        """The answer to a question, once; None if it has not come."""
        return self._answers.pop(number, None)

    # Behaviours

    def ask(self, question: Question) -> Generator[Command, None, ServerAnswer]:
        """Ask the fleet's map, and stand until the answer comes or is overdue.

        A busy server says when to ask again.
        """
        self._questions.append(question)
        answer, again = ServerAnswer(question.number, None, NO_ANSWER), math.inf
        for _ in range(self._patience):
            yield Command()
            if question.number in self._answers:
                answer = self._answers.pop(question.number)
                if answer.content is not None or not answer.retry_after:
                    return answer
                again = self.now + answer.retry_after
            if self.now >= again:
                self._questions.append(question)
                again = math.inf
        return answer

    def stand(self, seconds: float) -> Behaviour:
        """Stand still."""
        for _ in range(max(1, round(seconds / self._description.tick))):
            yield Command()

    def turn(self, angle: float, rate: float) -> Behaviour:
        """Turn on the spot by the wheels; a robot that cannot turn gives up after three times the time.

        Args:
            angle: rad.
            rate: rad/s, not negative.
        """
        turned = 0.0
        for _ in range(math.ceil(3.0 * abs(angle) / rate / self._description.tick) + 1):
            if abs(turned) >= abs(angle):
                return
            yield Command(0.0, math.copysign(rate, angle))
            turned += self.observation.odometry.turn

    def drive_on(self, way: float, speed: float) -> Behaviour:
        """Drive straight on, no further than the rangers see room.

        Args:
            way: m.
            speed: m/s.
        """
        begin = self.odom_from_robot
        for _ in range(math.ceil(2.0 * way / speed / self._description.tick)):
            left = way - begin.distance(self.odom_from_robot)
            if left < 0.02 or self.room(0.0) < 0.02:
                return
            yield Command(speed, 0.0)

    def room(self, direction: float) -> float:
        """How far the robot may move in a direction (rad, 0 ahead), m; 0 where no ranger points."""
        return clearance(self._description, self.observation.proximity, direction, 0.0)

    def freest(self, most: float = math.inf) -> tuple[float, float]:
        """Room and direction (m, rad) of most room; rooms above `most` m count the same."""
        ways = [(min(self.room(bearing), most), bearing) for bearing in self._description.ranger_bearings]
        return max(ways, key=lambda one: one[0], default=(0.0, 0.0))
