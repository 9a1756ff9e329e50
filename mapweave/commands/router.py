"""`mapweave router`: the Zenoh router alone, for robots without a map server."""

import argparse
from contextlib import ExitStack
from typing import Any

from mapweave.commands import values
from mapweave.commands.network import (
    add_log_format,
    add_network,
    key_renewal,
    network_of,
    router_settings,
    settings_of,
    stop_on_signals,
)


def add_to(commands: Any) -> None:
    """Declare the command."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "router",
        help="run the router alone, without a map server",
        description="Run the Zenoh router for robots and tools, without a map server. It needs only the "
        "base installation. Maps are not merged; robots keep them on their own disks and send them when a "
        "map server can be reached. A map server elsewhere joins it with --connect.",
    )
    parser.add_argument(
        "--name", type=values.name,
        help="of the server whose key this router has, with --keys (default: `server` of the settings, s0)",
    )  # fmt: skip
    parser.add_argument(
        "--print-config", action="store_true",
        help="print the configuration as JSON5 for a zenohd, which takes the same, and end; with --keys it "
        "contains the private key",
    )  # fmt: skip
    add_log_format(parser)
    add_network(parser, listens=True)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Route until stopped."""
    from mapweave.terminal import log_with_time, stamped
    from mapweave.wire.zenoh_bus import ZenohBus
    from mapweave.wire.zenoh_config import router_file
    from mapweave.wire.zenoh_log import ZenohLog

    log_with_time(arguments.log_format)
    network = network_of(arguments, settings_of(arguments))
    name = arguments.name or network.server
    settings, keys = router_settings(network, name)
    if arguments.print_config:
        print(router_file(settings))
        return 0
    stop = stop_on_signals()
    with ExitStack() as stack:
        if keys is not None:
            stack.enter_context(ZenohLog())
        bus = ZenohBus(settings)
        stack.callback(bus.close)
        print(stamped(f"router listens at {', '.join(settings.listen)}"), flush=True)
        renewal = key_renewal(bus, keys, name, settings)
        while not stop.wait(1.0):
            if renewal is not None:
                renewal.check()
    return 0
