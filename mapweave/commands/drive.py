"""`mapweave drive`: drive a robot by hand."""

from __future__ import annotations

import argparse
import select
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapweave.commands import values
from mapweave.commands.network import (
    add_author,
    add_network,
    key_holder,
    network_of,
    reach,
    settings_of,
    stop_on_signals,
)

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from mapweave.teleoperation.gamepad import Gamepad
    from mapweave.teleoperation.keyboard import Keyboard, RawTerminal
    from mapweave.teleoperation.session import Session

TICK = 0.05
"""Between two looks at the keys, s."""
STANDS = "stands until someone drives it and quits, or gives it a mission"
"""What the robot does that has lost who drives it."""
SHOWN = 0.2
"""Between two states on the screen, s."""


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "drive",
        help="drive a robot by hand",
        description="Drive the robot of a running agent by keyboard or gamepad. Its mission waits meanwhile; "
        "with the missions explore and carried it maps. It stands when no command arrives for 0.5 s.",
    )
    parser.add_argument("name", type=values.name, help="of the agent, for example r0")
    parser.add_argument(
        "--gamepad", type=Path, nargs="?", const=Path("/dev/input/js0"), metavar="DEVICE",
        help="drive by the left stick of a gamepad (default device: /dev/input/js0)",
    )  # fmt: skip
    parser.add_argument(
        "--speed", type=float, default=0.5, metavar="SHARE",
        help="share of the robot's speed limits, 0.1 to 1 (default: 0.5)",
    )  # fmt: skip
    add_author(parser)
    add_network(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Drive until the person quits."""
    from mapweave.commands.usage import UsageError
    from mapweave.fleet import author
    from mapweave.fleet_questions import check_role
    from mapweave.hybridmap.errors import Refused
    from mapweave.teleoperation.gamepad import Gamepad
    from mapweave.teleoperation.keyboard import Keyboard, RawTerminal
    from mapweave.teleoperation.session import Session

    name: str = arguments.name
    if not 0.1 <= arguments.speed <= 1.0:
        raise UsageError(f"--speed: {arguments.speed:g} is not within 0.1 to 1")
    network = network_of(arguments, settings_of(arguments))
    holder = key_holder(network)
    check_role(holder)
    by = author(holder, arguments.by)
    gamepad = None if arguments.gamepad is None else Gamepad(arguments.gamepad, arguments.speed)
    terminal = RawTerminal() if gamepad is None else None
    stop = stop_on_signals()
    bus, keys = reach(network)
    try:
        with Session(bus, keys, name, by, "" if holder is None else holder.name) as session:
            if gamepad is not None:
                _by_gamepad(session, name, gamepad, stop)
            elif terminal is not None:
                with terminal:
                    _by_keyboard(session, name, terminal, Keyboard(arguments.speed), stop)
        if session.refused:
            raise Refused(f"{name}: {session.refused}")
    finally:
        bus.close()
        if gamepad is not None:
            gamepad.close()
    return 0


def _by_keyboard(
    session: Session, name: str, terminal: RawTerminal, keyboard: Keyboard, stop: threading.Event
) -> None:
    from mapweave.hybridmap.errors import DeviceError
    from mapweave.teleoperation.keyboard import HELP

    show = _shown(session, name, lambda: HELP)
    while not (stop.is_set() or keyboard.quit or session.refused):
        if select.select([terminal], [], [], TICK)[0]:
            data = terminal.read()
            if not data:
                break
            keyboard.feed(data, time.monotonic())
        session.want(*keyboard.wanted(time.monotonic()))
        show()
    # The signal of its end stops this loop as Ctrl-C does, and no person has quit.
    if terminal.gone:
        raise DeviceError(f"the terminal is gone. {name} {STANDS}")


def _by_gamepad(session: Session, name: str, gamepad: Gamepad, stop: threading.Event) -> None:
    from mapweave.hybridmap.errors import DeviceError

    show = _shown(session, name, lambda: f"{gamepad.hint}, Ctrl-C quits")
    while not (stop.is_set() or session.refused):
        if select.select([gamepad], [], [], TICK)[0]:
            try:
                gamepad.read()
            except DeviceError as error:
                raise DeviceError(f"{error}. {name} {STANDS}") from None
        session.want(*gamepad.wanted())
        show()


def _shown(session: Session, name: str, usage: Callable[[], str]) -> Any:
    """A function that shows the state, no more often than people can read it."""
    from mapweave.agent.teleoperation import DEAD_MAN
    from mapweave.teleoperation.display import Display, lines

    display, last = Display(), [0.0]

    def show() -> None:
        now = time.monotonic()
        if now - last[0] < SHOWN or session.answer is None:
            return
        last[0] = now
        silence = now - session.answered
        display.show(
            lines(
                name, session.answer.report, session.command, silence if silence > DEAD_MAN else 0.0, usage()
            )
        )

    return show
