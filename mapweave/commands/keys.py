"""`mapweave keys`: who belongs to a fleet, and what each may do."""

import argparse
import sys
from pathlib import Path
from typing import Any

from mapweave.commands import values
from mapweave.commands.answer import add_json, print_answer, print_said
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.errors import Refused

ROLES = ("robot", "server", "operator", "viewer")


def add_to(commands: Any) -> None:
    """Declare the command and its actions."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "keys",
        help="keys of robots, servers and people, for a network that others can reach",
        description="Without keys the map server listens on its own machine alone. With keys it serves a "
        "network: each robot, server and person has a key file, and the router lets each do what its role "
        "may: a robot writes its own map and asks, a viewer reads, an operator gives missions and corrects.",
        epilog="In order: mapweave keys init --at 192.168.1.10; mapweave keys add r0; "
        "mapweave server --keys keys; on the robot: mapweave agent r0 --keys r0.key.toml",
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True, title="actions")

    init = _action(actions, "init", "make the keys of a fleet, and those of its map server")
    init.add_argument("--fleet", default="demo", metavar="NAME", help="name of the fleet (default: demo)")
    init.add_argument(
        "--at", action="append", default=[], metavar="HOST",
        help="name or address under which robots reach the server; may be repeated (default: 127.0.0.1)",
    )  # fmt: skip
    init.add_argument(
        "--profile", choices=("production", "lab"), default="production",
        help="production: certificates over mutual TLS; lab: users and passwords, unencrypted, for a network "
        "that you trust (default: production)",
    )  # fmt: skip
    init.add_argument("--server", default="s0", metavar="NAME", help="name of the map server (default: s0)")
    init.set_defaults(run=_init)

    add = _action(actions, "add", "give a robot, server or person a key, or a new one")
    add.add_argument("name", type=values.name, metavar="NAME", help="a robot's name is that of its agent")
    add.add_argument("--role", choices=ROLES, default="robot", help="what it may do (default: robot)")
    add.add_argument(
        "--days", type=float,
        help="for which it holds (default: 365); passwords of the lab profile do not expire",
    )  # fmt: skip
    add.add_argument(
        "--at", action="append", default=[], metavar="HOST",
        help="of a server: a further name or address under which robots reach it; may be repeated",
    )  # fmt: skip
    add.set_defaults(run=_add)

    token = _action(actions, "token", "a token with which a person or a script logs in over HTTP")
    token.add_argument("name", metavar="NAME", help="who has a key already, see `mapweave keys add`")
    token.add_argument("--days", type=float, default=90.0, help="for which it holds (default: 90)")
    token.set_defaults(run=_token)

    listing = _action(actions, "list", "who has a key, and until when")
    listing.set_defaults(run=_list)

    revoke = _action(actions, "revoke", "admit an identity no more, at once")
    revoke.add_argument("name", metavar="NAME", help="who has a key, see `mapweave keys list`")
    revoke.add_argument(
        "--because", type=values.remark, default="", metavar="TEXT", help="why; the router's log says it"
    )
    revoke.add_argument("--tokens", action="store_true", help="only the tokens for HTTP; the key stays good")
    revoke.add_argument(
        "--force", action="store_true", help="also the only server, which goes on with its key until it ends"
    )
    revoke.set_defaults(run=_revoke)

    bundle = _action(actions, "bundle", "the one file to copy to a robot or person")
    bundle.add_argument("name", metavar="NAME", help="who has a key, see `mapweave keys list`")
    bundle.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="where to")
    bundle.set_defaults(run=_bundle)


def _action(actions: Any, name: str, words: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = actions.add_parser(
        name, help=words, description=f"{words[0].upper()}{words[1:]}."
    )
    parser.add_argument(
        "--keys", type=Path, default=Path("keys"), metavar="FOLDER", help="folder of the keys (default: keys)"
    )
    add_json(parser)
    return parser


def _init(arguments: argparse.Namespace) -> int:
    from mapweave.identities.key_folder import KeyFolder, Profile

    profile = Profile(arguments.profile)
    with arguments_read():
        folder = KeyFolder.create(arguments.keys, arguments.fleet, profile, arguments.at, arguments.server)
    where = ", ".join(folder.catalogue.endpoints)
    said = [f"{arguments.keys}: keys of fleet {arguments.fleet}; robots find the server at {where}"]
    if not arguments.at:
        said.append(
            "that is this machine alone: give --at HOST if robots are to reach it (in another folder)"
        )
    if profile is Profile.LAB:
        said.append("passwords and maps travel unencrypted: use it only in a network that you trust")
    said.append(
        f"next: mapweave keys add r0 --keys {arguments.keys}; mapweave server --keys {arguments.keys}"
    )
    endpoints = list(folder.catalogue.endpoints)
    print_said(
        arguments,
        *said,
        folder=str(arguments.keys),
        fleet=arguments.fleet,
        profile=profile,
        endpoints=endpoints,
    )
    return 0


def _add(arguments: argparse.Namespace) -> int:
    from mapweave.identities.hosts import check_hosts
    from mapweave.identities.key_file import read_key_file
    from mapweave.identities.key_folder import KeyFolder, Profile
    from mapweave.identities.tokens import time_of
    from mapweave.identities.validity import validity
    from mapweave.wire.credentials import Role

    if arguments.at and arguments.role != Role.SERVER:
        raise UsageError("--at: is for a server; a robot's key names the servers that the fleet has")
    with arguments_read():
        check_hosts(arguments.at)
    days = 365.0 if arguments.days is None else arguments.days
    _check_days(days)
    folder = KeyFolder(arguments.keys)
    if arguments.days is not None and folder.catalogue.profile is Profile.LAB:
        raise UsageError(
            "--days: passwords of the lab profile do not expire; `mapweave keys revoke` ends one"
        )
    path = folder.add(arguments.name, Role(arguments.role), days, arguments.at)
    said = [f"{path}: copy this file to {arguments.name}, and to no other"]
    ends, identity = validity(read_key_file(path).credentials.certificate), folder.find(arguments.name)
    if ends is not None and identity is not None and time_of(identity.expires) > ends[1]:
        until = identity.expires[:10]
        said.append(
            f"an earlier key of {arguments.name} is good until {until}: if it is to end before, first "
            f"`mapweave keys revoke {arguments.name}`, then add it again"
        )
    if arguments.at:
        where = ", ".join(folder.catalogue.endpoints)
        said.append(
            f"new keys find the servers at {where}; who has an older key needs `endpoints` in its settings"
        )
    expires = None if ends is None else ends[1].isoformat()
    print_said(arguments, *said, file=str(path), name=arguments.name, role=arguments.role, expires=expires)
    return 0


def _token(arguments: argparse.Namespace) -> int:
    from mapweave.identities.key_folder import KeyFolder

    _check_days(arguments.days)
    token = KeyFolder(arguments.keys).token(arguments.name, arguments.days)
    print(f"the token of {arguments.name}, which is shown this once:", file=sys.stderr)
    print_answer(arguments, {"name": arguments.name, "token": token}, [token])
    return 0


def _check_days(days: float) -> None:

    if not 0.0 < days <= 3650.0:
        raise UsageError(f"--days {days:g}: give more than 0, and at most 3650")


def _list(arguments: argparse.Namespace) -> int:
    from mapweave.identities.key_folder import KeyFolder
    from mapweave.identities.tokens import read_tokens

    catalogue = KeyFolder(arguments.keys).catalogue
    tokens = {
        one.name: [token for token in read_tokens(arguments.keys) if token.name == one.name]
        for one in catalogue.identities
    }
    rows = [
        {"name": one.name, "role": one.role, "state": one.state, "issued": one.issued,
         "expires": one.expires,
         "tokens": [{"issued": token.issued, "expires": token.expires} for token in tokens[one.name]]}
        for one in catalogue.identities
    ]  # fmt: skip
    values = {"fleet": catalogue.fleet, "profile": catalogue.profile, "identities": rows}
    lines = [f"fleet {catalogue.fleet}, profile {catalogue.profile}"]
    width = max(len(one.name) for one in catalogue.identities)
    for one in catalogue.identities:
        until = f", until {one.expires[:10]}" if one.expires and not one.revoked else ""
        lines.append(f"{one.name:<{width}}  {one.role:<8}  {one.state}{until}")
        for token in tokens[one.name]:
            ends = "expired" if token.expired else f"until {token.expires[:10]}"
            lines.append(f"{'':<{width}}  token of {token.issued[:10]}, {ends}")
    print_answer(arguments, values, lines)
    return 0


def _revoke(arguments: argparse.Namespace) -> int:
    from mapweave.identities.key_folder import KeyFolder

    folder = KeyFolder(arguments.keys)
    if arguments.tokens:
        if folder.find(arguments.name) is None or not folder.end_tokens(arguments.name):
            raise Refused(f"{arguments.name} has no token; `mapweave keys list` shows who has")
        said = f"the tokens of {arguments.name} are void, and who logged in with them is logged out"
    else:
        folder.revoke(arguments.name, " ".join(arguments.because.split()), arguments.force)
        said = f"{arguments.name} is admitted no more; a running server takes note within seconds"
    print_said(arguments, said, name=arguments.name)
    return 0


def _bundle(arguments: argparse.Namespace) -> int:
    from mapweave.identities.key_file import read_key_file, write_key_file
    from mapweave.identities.key_folder import KeyFolder
    from mapweave.refusals import refusals

    folder = KeyFolder(arguments.keys)
    with refusals():
        file = folder.key_file(arguments.name)
    identity = folder.find(arguments.name)
    if identity is None or identity.state != "good":
        # A command that was killed half-way leaves such a file.
        state = "is not in the list of identities" if identity is None else f"is {identity.state}"
        role = f" --role {ROLES[0] if identity is None else identity.role}"
        raise Refused(
            f"the key of {arguments.name} {state}: no router lets it in; `mapweave keys add "
            f"{arguments.name}{role}` makes a new one"
        )
    write_key_file(arguments.out, read_key_file(file))
    said = f"{arguments.out}: the key of {arguments.name}"
    print_said(arguments, said, file=str(arguments.out), name=arguments.name)
    return 0
