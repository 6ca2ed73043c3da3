"""Access rules as Zenoh's access control takes them: rights by key, message and peer, all else refused.

What a peer sends is checked. What is sent to a peer is not, beyond that: it could only come because the peer was
allowed to subscribe to it or to ask for it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, Final

import zenoh

from omnibench.errors import ConfigError
from omnibench.live.network.session_config import Access
from omnibench.live.wire.topics import INPUTS, TOPICS, topic_name

_WRITE: Final = ("put", "delete", "declare_queryable", "reply", "liveliness_token")
_READ: Final = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")

_ALIVE: Final = "omnibench/{}/alive"
_ANSWERS: Final = tuple("omnibench/{}/" + service for service in ("info", "calibration", "health", "pose"))
_SERVICES: Final = "omnibench/{}/*"
_ROS_GRAPH: Final = "@ros2_lv/**"  # rmw_zenoh's tokens: who is there, no data
_ADVANCED: Final = "/@adv/**"  # below a key: what advanced publishers and subscribers say to each other

_OUTPUTS: Final = tuple(topic for topic in TOPICS if topic not in INPUTS)

Rights = dict[str, dict[str, list[str]]]
"""who -> write, read -> keys"""


def rights_of(access: Access) -> Rights:
    """Every name's keys, the shorthands written out. ConfigError when a key expression is not one."""
    rights: Rights = defaultdict(lambda: {"write": [], "read": []})

    def grant(who: Iterable[str], *, write: Iterable[str] = (), read: Iterable[str] = ()) -> None:
        for name in who:
            rights[name]["write"] += write
            rights[name]["read"] += read

    for robot, name in access.robots.items():
        own = (f"{robot}/**", f"*/{robot}/**", *_topics(robot, ("tf",)), *_services(robot, *_ANSWERS))
        grant([name], write=[*_topics(robot, INPUTS), _ROS_GRAPH], read=[*own, *_services("*", _ALIVE), _ROS_GRAPH])
    every = [*_topics("*", TOPICS), _ROS_GRAPH]
    answers = _services("*", *_ANSWERS, _ALIVE)
    grant(access.nodes, write=[*_topics("*", _OUTPUTS), *_services("*", _SERVICES), _ROS_GRAPH])
    grant(access.nodes, read=[*every, *_services("*", _SERVICES)])
    grant(access.viewers, write=[_ROS_GRAPH], read=[*every, *answers])
    grant(access.operators, write=[_ROS_GRAPH, "omnibench/*/calibration"], read=[*every, *_services("*", _SERVICES)])
    for rule in access.rules:
        grant(rule.who, write=rule.write, read=rule.read)
    return {
        who: {kind: sorted(_with_advanced(_checked(key) for key in keys)) for kind, keys in granted.items()}
        for who, granted in rights.items()
    }


def access_control(access: Access, *, by_certificate: bool, own_name: str | None = None) -> dict[str, Any]:
    """Zenoh's setting ``access_control``.

    by_certificate: names are certificates' common names, else users'. own_name: the router's own. Who can show it holds
    the router's key or password, and may do all: other programs on the router's machine.
    """
    property_name = "cert_common_names" if by_certificate else "usernames"
    rights = rights_of(access)
    if own_name is not None:
        everything = sorted(_with_advanced(["**", _ROS_GRAPH]))
        rights[own_name] = {"write": everything, "read": everything}
    named = {key for granted in rights.values() for keys in granted.values() for key in keys if "@" in key}
    rules = [
        # Whoever is not named is somebody, too: else its refusals would not be logged.
        _rule("nothing", "deny", "ingress", _WRITE + _READ, ["**"]),
        _rule("outgoing", "allow", "egress", _WRITE + _READ, sorted({"**", "**" + _ADVANCED, *named})),
    ]
    policies = [{"id": "anyone", "subjects": ["anyone"], "rules": ["nothing"]}]
    subjects: list[dict[str, Any]] = [{"id": "anyone"}]
    for number, (who, granted) in enumerate(rights.items()):
        mine = [
            _rule(f"{number} {kind}", "allow", "ingress", messages, granted[kind])
            for kind, messages in (("write", _WRITE), ("read", _READ))
            if granted[kind]
        ]
        rules += mine
        subjects.append({"id": f"{number}", property_name: [who]})
        policies.append({"id": f"{number}", "subjects": [f"{number}"], "rules": ["outgoing", *(r["id"] for r in mine)]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, permission: str, flow: str, messages: tuple[str, ...], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": permission, "flows": [flow], "messages": [*messages], "key_exprs": keys}


def _topics(robot: str, topics: Iterable[str]) -> list[str]:
    """A robot's topics in all profiles: by name alone, and with domain, type and hash."""
    names = [topic_name(robot, topic) for topic in topics]
    return [*names, *(f"*/{name}/*/*" for name in names)]


def _services(robot: str, *patterns: str) -> list[str]:
    return [pattern.format(robot) for pattern in patterns]


def _with_advanced(keys: Iterable[str]) -> set[str]:
    return {each for key in keys for each in ((key,) if "@" in key else (key, key + _ADVANCED))}


def _checked(key: str) -> str:
    try:
        return str(zenoh.KeyExpr.autocanonize(key))
    except zenoh.ZError as error:
        raise ConfigError(f"access: {key!r} is no key expression: {str(error).split(': ', 1)[-1]}") from None
