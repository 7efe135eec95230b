"""Who may do what on a secured router: Zenoh's `access_control` and size limits, written from the table of topics.

Everything is denied unless `common.topics` says that this process writes or reads that topic of that vehicle. A process
is known by the common name of its certificate, `{role}.{vehicle}`, such as `planner.ego`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from common.topics import STATUS_OF, TOPICS, Delivery, Topic, alive_key, checked_vehicle, key

ROLES = (*STATUS_OF, "rig")
"""Every process that may join: those with a status, and the bench, which plays the vehicle and reads everything."""
ROUTER = "router"

_DECLARED = ("declare_queryable", "liveliness_token", "reply")
_ASKED = ("query", "liveliness_query", "declare_liveliness_subscriber")


@dataclass(frozen=True)
class _Rule:
    """Some kinds of message in one direction (seen from the router), allowed on some keys."""

    flow: str
    messages: tuple[str, ...]
    keys: tuple[str, ...]


def common_name(role: str, vehicle: str) -> str:
    """Name in the certificate of a vehicle's process, or of its router.

    Raises:
        ValueError: no such role, or a name that may not stand in a key.
    """
    if role not in (*ROLES, ROUTER):
        raise ValueError(f"no role {role!r}: one of {', '.join((*ROLES, ROUTER))}")
    return f"{role}.{checked_vehicle(vehicle)}"


def writes(role: str) -> tuple[Topic, ...]:
    """Topics that a role may send."""
    acts_as = "vehicle" if role == "rig" else role
    return tuple(t for t in TOPICS.values() if t.writer == acts_as)


def reads(role: str) -> tuple[Topic, ...]:
    """Topics that a role may hear."""
    return tuple(t for t in TOPICS.values() if role == "rig" or role in t.readers)


def access_control(vehicles: Sequence[str], routers: Iterable[str] = ()) -> dict[str, Any]:
    """Zenoh's section `access_control`: denied unless allowed here.

    Args:
        vehicles: names of the vehicles that this router serves.
        routers: names of the other routers that may pass on what these vehicles say, without `router.`.

    Raises:
        ValueError: a name that may not stand in a key.
    """
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def allow(name: str, granted: Iterable[_Rule]) -> None:
        ids: list[str] = []
        for rule in granted:
            if rule.keys:
                ids.append(f"{name}/{len(ids)}")
                rules.append(
                    {
                        "id": ids[-1],
                        "permission": "allow",
                        "flows": [rule.flow],
                        "messages": list(rule.messages),
                        "key_exprs": list(rule.keys),
                    }
                )
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"id": name, "rules": ids, "subjects": [name]})

    for vehicle in vehicles:
        for role in ROLES:
            allow(common_name(role, vehicle), _rules(role, vehicle))
    for other in routers:
        allow(common_name(ROUTER, other), [rule for vehicle in vehicles for rule in _passing_on(vehicle)])
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def size_limits(vehicles: Sequence[str]) -> list[dict[str, Any]]:
    """Zenoh's section `low_pass_filter`: what is larger than its topic allows stops at the router."""
    return [
        {
            "id": f"{vehicle}/{topic.suffix}",
            "flows": ["ingress"],
            "messages": ["put", "reply"],
            "key_exprs": [key(vehicle, topic)],
            "size_limit": topic.max_bytes + topic.max_header_bytes,
        }
        for vehicle in vehicles
        for topic in TOPICS.values()
    ]


def _rules(role: str, vehicle: str) -> list[_Rule]:
    sent, heard = writes(role), reads(role)
    into = tuple(key(vehicle, t) for t in sent)
    out = tuple(key(vehicle, t) for t in heard)
    latched_in, latched_out = _latched(vehicle, sent), _latched(vehicle, heard)
    own = alive_key(vehicle, "vehicle" if role == "rig" else role)
    everyone = alive_key(vehicle, "any").removesuffix("any") + "*"
    watched = (everyone,) if any(t in STATUS_OF.values() for t in heard) else ()
    return [
        # what it sends, and the word that somebody wants it
        _Rule("ingress", ("put",), into),
        _Rule("egress", ("declare_subscriber",), into),
        _Rule("ingress", _DECLARED, latched_in),
        _Rule("ingress", ("reply",), tuple(key(vehicle, t) for t in sent if t.delivery is Delivery.LATCHED)),
        _Rule("egress", _ASKED, latched_in),
        _Rule("ingress", ("liveliness_token",), (own,)),
        # what it hears
        _Rule("ingress", ("declare_subscriber",), out),
        _Rule("egress", ("put",), out),
        _Rule("ingress", _ASKED, latched_out),
        _Rule("egress", _DECLARED, latched_out),
        _Rule("egress", ("reply",), tuple(key(vehicle, t) for t in heard if t.delivery is Delivery.LATCHED)),
        _Rule("ingress", ("liveliness_query", "declare_liveliness_subscriber"), watched),
        _Rule("egress", ("liveliness_token",), watched),
    ]


def _passing_on(vehicle: str) -> list[_Rule]:
    keys = (*(key(vehicle, t) for t in TOPICS.values()), *_latched(vehicle, TOPICS.values()))
    alive = alive_key(vehicle, "any").removesuffix("any") + "*"
    everything = ("put", "declare_subscriber", *_DECLARED, *_ASKED)
    return [_Rule(flow, everything, (*keys, alive)) for flow in ("ingress", "egress")]


def _latched(vehicle: str, topics: Iterable[Topic]) -> tuple[str, ...]:
    """Keys under which Zenoh's advanced publishers answer late joiners (`**` alone does not match `@adv`)."""
    return tuple(f"{key(vehicle, t)}/@adv/**" for t in topics if t.delivery is Delivery.LATCHED)
