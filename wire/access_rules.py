"""The router's rules: what each identity may send and receive. What no rule names is denied.

Zenoh checks what a client sends (ingress) and what is sent to it (egress), by the kind of the message and its
key. Declarations, questions and answers are messages too: a robot that may not declare itself the answerer
for `server/s0/route` gets no question.
"""

from collections.abc import Sequence

from mapweave.wire.credentials import Role, RouterAccess
from mapweave.wire.keys import Keys
from mapweave.wire.senders import sent_by

ASKS = (
    "relocalize", "route", "known", "reserve", "nearby", "mission", "missions", "robots", "map", "explain",
    "constrain", "constraints", "annotate", "annotations", "resolve", "plans", "plan_image",
    "put_plan_image", "history", "status",
)  # fmt: skip
"""Every question to a server, by the last part of its key."""
COMMANDS = frozenset({"constrain", "annotate", "put_plan_image", "mission"})
"""Those that change something."""
SIGNED = frozenset({"constrain", "annotate", "mission"})
"""Those whose sender is recorded: people ask them under keys that end with their name alone."""
WATCHES = ("liveliness_query", "declare_liveliness_subscriber")
OF_ROBOTS = frozenset({"relocalize", "route", "known", "reserve", "nearby"})
"""Those of robots, each in its own name."""


def may_ask(role: Role) -> frozenset[str]:
    """The questions to a server that a role may ask, over any transport."""
    match role:
        case Role.ROBOT:
            return OF_ROBOTS | {"status"}
        case Role.VIEWER:
            return frozenset(ASKS) - COMMANDS
    return frozenset(ASKS)


def access_control(keys: Keys, access: RouterAccess, certified: bool) -> dict[str, object]:
    """Zenoh's `access_control`: default deny, one subject and one policy an identity.

    Args:
        keys: of the fleet.
        access: who is admitted.
        certified: whether identities are common names of certificates; else user names.
    """
    rules: list[dict[str, object]] = []
    subjects: list[dict[str, object]] = []
    policies: list[dict[str, object]] = []
    kind = "cert_common_names" if certified else "usernames"
    for member in access.members:
        name = member.name
        own: list[dict[str, object]] = [
            {"id": f"{name} {k}", "permission": "allow", "flows": [flow], "messages": list(messages),
             "key_exprs": list(patterns)}
            for k, (flow, messages, patterns) in enumerate(_allowed(keys, name, member.role))
        ]  # fmt: skip
        rules += own
        subjects.append({"id": name, kind: [member.subject]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
        "policies": policies,
    }  # fmt: skip


_Rule = tuple[str, Sequence[str], Sequence[str]]


def _allowed(keys: Keys, name: str, role: Role) -> list[_Rule]:
    """Flow, messages and keys of each rule."""
    if role is Role.SERVER:
        return _writes([f"{keys.root}/**"]) + _reads([f"{keys.root}/**"]) + _asks([f"{keys.root}/**"])
    if role is Role.ROBOT:
        return _robot(keys, name)
    questions = [
        sent_by(f"{keys.root}/server/*/{what}", name if what in SIGNED else "")
        for what in ASKS
        if what in may_ask(role)
    ]
    questions += [keys.agent_statuses(), f"{keys.root}/server/*/ack/*"]
    if role is Role.OPERATOR:
        questions += [sent_by(f"{keys.root}/agent/*/{what}", name) for what in ("mission", "portal", "drive")]
    reads = [
        keys.agent_statuses(), keys.server_statuses(), keys.agents_alive(), keys.servers_alive(),
        f"{keys.root}/server/*/poses/*",
    ]  # fmt: skip
    return [*_reads(reads), *_asks(questions)]


def _robot(keys: Keys, name: str) -> list[_Rule]:
    agent, base = f"{keys.root}/agent/{name}", f"{keys.root}/robot/{name}"
    questions = [sent_by(f"{keys.root}/server/*/{what}", name) for what in sorted(OF_ROBOTS)]
    addressed = [f"{keys.root}/server/*/{what}/{name}" for what in ("ack", "poses")]
    return [
        # One declaration for all questions to it; which of them are let through says the next rule.
        ("ingress", ("declare_queryable",), [f"{agent}/**"]),
        *_writes([f"{agent}/change/*", f"{agent}/head/*", f"{agent}/alive/*", f"{base}/driver/*",
                  f"{agent}/log/*", f"{agent}/status", f"{agent}/mission", f"{agent}/mission/*",
                  f"{agent}/portal", f"{agent}/portal/*", f"{agent}/drive", f"{agent}/drive/*",
                  f"{agent}/view", f"{base}/describe", f"{base}/step"]),
        # A publisher hears who listens to its key, under any pattern. If it hears of none it sends nothing.
        ("egress", ("declare_subscriber",), ["**"]),
        *_reads([*addressed, keys.servers_alive(), f"{base}/driver/*", f"{agent}/alive/*"]),
        *_asks([*addressed, *questions, f"{keys.root}/server/*/status",
                f"{base}/describe", f"{base}/step", f"{agent}/log/*"]),
    ]  # fmt: skip


def _writes(patterns: list[str]) -> list[_Rule]:
    """Rules to publish, be alive and answer under these keys, and to be asked there."""
    return [
        ("ingress", ("put", "liveliness_token", "declare_queryable", "reply"), patterns),
        ("egress", ("query", "declare_subscriber", *WATCHES), patterns),
    ]


def _reads(patterns: list[str]) -> list[_Rule]:
    """Rules to hear what is published and who is alive under these keys."""
    return [
        ("ingress", ("declare_subscriber", *WATCHES), patterns),
        ("egress", ("put", "liveliness_token"), patterns),
    ]


def _asks(patterns: list[str]) -> list[_Rule]:
    """Rules to ask, and to get the answers."""
    return [("ingress", ("query",), patterns), ("egress", ("reply", "declare_queryable"), patterns)]
