"""Zenoh's access control from a config's access rules: rights by key, message and peer; all else is refused.

Messages from a peer (ingress) are checked. Messages to a peer (egress) are not: a peer only receives what it was
allowed to subscribe to or to query.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any, Final, Literal

import zenoh

from omnibench.errors import ConfigError
from omnibench.live.network.session_config import Access
from omnibench.live.wire.topics import INPUTS, TOPICS, topic_name

Right = Literal["write", "read", "ask", "put", "subscribe", "serve"]
_MESSAGES: Final[dict[Right, tuple[str, ...]]] = {
    "write": ("put", "delete", "declare_queryable", "reply", "liveliness_token"),
    "read": ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"),
    "ask": ("query",),
    "put": ("put",),
    "subscribe": ("declare_subscriber",),
    "serve": ("declare_queryable", "reply", "liveliness_token"),
}
_ALL: Final = _MESSAGES["write"] + _MESSAGES["read"]

_ALIVE: Final = "omnibench/{}/alive"
_CLAIM: Final = "omnibench/{}/claim-$*"
_RECEIVED: Final = "omnibench/{}/received/*"  # acknowledgements of what a replay sends
_ANSWERS: Final = tuple("omnibench/{}/" + service for service in ("info", "calibration", "health", "pose"))
_SERVICES: Final = "omnibench/{}/*"
_CALIBRATION: Final = "omnibench/{}/calibration"
# ROS 2's keys of a robot, in any domain: domain, name, type and hash. omnibench's services have fewer parts.
_ROS_KEYS: Final = "*/{}/*/**/*/*"
_ROS_GRAPH: Final = "@ros2_lv/**"  # rmw_zenoh's liveliness tokens: nodes and their topics, no data
_ADVANCED: Final = "/@adv/**"  # below a key: messages between Zenoh's advanced publishers and subscribers

_OUTPUTS: Final = tuple(topic for topic in TOPICS if topic not in INPUTS)

Rights = dict[str, dict[Right, list[str]]]
"""Peer's name -> right -> key expressions."""


def rights_of(access: Access) -> Rights:
    """The key expressions that each peer may write and read. ConfigError: a rule's key expression is not valid."""
    rights: Rights = defaultdict(lambda: defaultdict(list))

    def grant(who: Iterable[str], **keys: Iterable[str]) -> None:
        for name in who:
            for right in _MESSAGES:
                rights[name][right] += keys.get(right, ())

    tokens = [*_services("*", _ALIVE), _ROS_GRAPH]
    for robot, name in access.robots.items():
        own_keys = (f"{robot}/**", *_services(robot, _ROS_KEYS), *_topics(robot, ("tf",)))
        grant([name], write=[*_topics(robot, INPUTS), _ROS_GRAPH], read=[*own_keys, *tokens])
        received = _services(robot, _RECEIVED)
        grant([name], ask=[*_services(robot, *_ANSWERS), *received], subscribe=received)
    everything = [*_topics("*", TOPICS), *tokens]
    answers, services, calibrations = _services("*", *_ANSWERS), _services("*", _SERVICES), _services("*", _CALIBRATION)
    # Nodes answer for their robots and take calibrations; to give orders and calibrations is for operators alone.
    grant(access.nodes, write=[*_topics("*", _OUTPUTS), _ROS_GRAPH], serve=services)
    grant(access.nodes, read=[*everything, *_services("*", _CLAIM)], ask=answers, subscribe=calibrations)
    grant(access.nodes, put=_services("*", _RECEIVED))
    grant(access.viewers, write=[_ROS_GRAPH], read=everything, ask=answers)
    grant(access.operators, write=[_ROS_GRAPH], read=everything, ask=services, put=calibrations)
    for rule in access.rules:
        grant(rule.who, write=rule.write, read=rule.read)
    return {
        who: {right: sorted(_with_advanced(_checked(key) for key in keys)) for right, keys in granted.items()}
        for who, granted in rights.items()
    }


def access_control(access: Access, *, by_certificate: bool, own_name: str | None = None) -> dict[str, Any]:
    """Zenoh's setting ``access_control``.

    by_certificate: the rules' names are common names of certificates, else user names. own_name: the router's name;
    a peer that has it holds the router's key or password, as other programs on its machine do, and may do everything.
    """
    property_name = "cert_common_names" if by_certificate else "usernames"
    rights = rights_of(access)
    if own_name is not None:
        all_keys = sorted(_with_advanced(["**", _ROS_GRAPH]))
        rights[own_name] = {"write": all_keys, "read": all_keys}
    named = {key for granted in rights.values() for keys in granted.values() for key in keys if "@" in key}
    rules = [
        # Peers without a rule are a subject too, or Zenoh would not log that they are refused.
        _rule("nothing", "deny", "ingress", _ALL, ["**"]),
        _rule("outgoing", "allow", "egress", _ALL, sorted({"**", "**" + _ADVANCED, *named})),
    ]
    policies = [{"id": "anyone", "subjects": ["anyone"], "rules": ["nothing"]}]
    subjects: list[dict[str, Any]] = [{"id": "anyone"}]
    for number, (who, granted) in enumerate(rights.items()):
        peer_rules = [
            _rule(f"{number} {right}", "allow", "ingress", _MESSAGES[right], keys)
            for right, keys in granted.items()
            if keys
        ]
        rules += peer_rules
        names = [rule["id"] for rule in peer_rules]
        subjects.append({"id": f"{number}", property_name: [who]})
        policies.append({"id": f"{number}", "subjects": [f"{number}"], "rules": ["outgoing", *names]})
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
    """The keys of a robot's topics in all profiles: the name alone, and with domain, type and hash around it."""
    names = [topic_name(robot, topic) for topic in topics]
    return [*names, *(f"*/{name}/*/*" for name in names)]


def _services(robot: str, *patterns: str) -> list[str]:
    return [pattern.format(robot) for pattern in patterns]


def _with_advanced(keys: Iterable[str]) -> set[str]:
    keys = set(keys)
    return keys | {key + _ADVANCED for key in keys if "@" not in key}


def _checked(key: str) -> str:
    try:
        return str(zenoh.KeyExpr.autocanonize(key))
    except zenoh.ZError as error:
        raise ConfigError(f"access: {key!r} is not a key expression: {str(error).split(': ', 1)[-1]}") from None
