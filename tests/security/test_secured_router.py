"""Over a real secured router: who does not belong gets nothing in or out, and what belongs still arrives.

A denied put is silent, so every test proves with a positive control that a message of the same kind does arrive.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from common import access, topics
from common.bus import Bus, BusSettings, NoRouterError, free_port, open_bus, router
from common.bus_config import Secured, TlsSettings
from common.config import ConfigError
from common.router import main as router_main
from rig import certificates
from services.planner.__main__ import SERVICE as PLANNER
from services.predictor.__main__ import SERVICE as PREDICTOR
from services.riskfield.__main__ import SERVICE as RISKFIELD
from tests import samples
from tests.security.bench import (
    DAY,
    VEHICLE,
    Bench,
    arrived,
    bench,
    control,
    message,
    put_raw,
    raw,
    refused,
    session,
)  # fmt: skip
from tests.waiting import until

TOPICS = list(topics.TOPICS.values())


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with bench(tmp_path_factory.mktemp("certificates")) as b:
        yield b


@pytest.fixture
def vehicle(secured: Bench) -> Iterator[Bus]:
    with secured.joined("vehicle") as bus:
        yield bus


@pytest.fixture
def predictor(secured: Bench) -> Iterator[Bus]:
    with secured.joined("predictor") as bus:
        yield bus


# --- the table ---


@pytest.mark.parametrize("service", [PREDICTOR, RISKFIELD, PLANNER], ids=lambda s: s.name)
def test_each_service_may_do_what_it_does_and_send_nothing_else(service: Any) -> None:
    assert set(service.subscribes) <= set(access.reads(service.name))
    assert set(access.writes(service.name)) == {service.publishes, topics.STATUS_OF[service.name]}


def test_the_planner_may_hear_ego_map_route_and_risk_and_nothing_else() -> None:
    assert {t.suffix for t in access.reads("planner")} == {"ego", "map", "route", "risk"}


def test_every_topic_has_one_writer_and_the_bench_may_stand_in_for_the_vehicle_alone() -> None:
    assert {t.writer for t in TOPICS} == set(access.ROLES) - {"rig"}
    assert access.writes("rig") == access.writes("vehicle")
    assert set(access.reads("rig")) == set(TOPICS)


@pytest.mark.parametrize("role", access.ROLES)
def test_what_a_process_puts_arrives_exactly_where_the_table_lets_it(secured: Bench, role: str) -> None:
    """Every role tries every topic; the bench listens to all."""
    seen: set[str] = set()
    with session(secured.settings("rig")) as listener, session(secured.settings(role)) as sender:
        held = [
            listener.declare_subscriber(topics.key(VEHICLE, t), lambda _, suffix=t.suffix: seen.add(suffix))
            for t in TOPICS
        ]
        allowed = {t.suffix for t in access.writes(role)}

        def tried() -> bool:
            for topic in TOPICS:
                put_raw(sender, topic)
            return seen >= allowed

        until(tried, every_s=0.05, what=f"the topics of {role}")
        tried()  # once more: whatever was let in late is seen before the rightful last one
        status = topics.STATUS_OF["vehicle" if role == "rig" else role]
        seen.discard(status.suffix)
        until(lambda: put_raw(sender, status) or status.suffix in seen, every_s=0.05, what="the last of them")
        assert seen == allowed
        del held


@pytest.mark.parametrize("role", access.ROLES)
def test_a_process_hears_exactly_what_the_table_lets_it(secured: Bench, role: str) -> None:
    """Every role subscribes to every topic and to everything at once; each rightful sender speaks."""
    seen: set[str] = set()
    everything: list[str] = []
    with ExitStack() as stack:
        listener = stack.enter_context(session(secured.settings(role)))
        held = [
            listener.declare_subscriber(topics.key(VEHICLE, t), lambda _, suffix=t.suffix: seen.add(suffix))
            for t in TOPICS
        ]
        greedy = stack.enter_context(session(secured.settings(role)))
        held.append(greedy.declare_subscriber("**", lambda s: everything.append(str(s.key_expr))))
        writers = {
            name: stack.enter_context(session(secured.settings(name)))
            for name in access.ROLES if name not in ("rig", role)
        }  # fmt: skip
        # what a session says to itself never meets the router: it is no evidence
        allowed = {t.suffix for t in access.reads(role) if t.writer in writers}
        control_reader = stack.enter_context(session(secured.settings("rig")))
        control_seen: set[str] = set()
        for t in TOPICS:
            held.append(
                control_reader.declare_subscriber(
                    topics.key(VEHICLE, t), lambda _, suffix=t.suffix: control_seen.add(suffix)
                )
            )

        def told() -> bool:
            for topic in TOPICS:
                if topic.writer in writers:
                    put_raw(writers[topic.writer], topic)
            return seen >= allowed and control_seen >= {t.suffix for t in TOPICS if t.writer in writers}

        until(told, every_s=0.05, what=f"what {role} may hear")
        control_seen.clear()
        until(told, every_s=0.05, what="everything once more")
        assert seen == allowed
        assert not everything, "a wildcard opens nothing"
        del held


# --- who gets in ---


def test_who_has_no_certificate_is_not_let_in(secured: Bench, vehicle: Bus, predictor: Bus) -> None:
    publisher, inbox = vehicle.publisher(topics.EGO), predictor.inbox(topics.EGO)
    control(publisher, inbox)
    assert refused(secured.settings("vehicle"), connect_certificate=None, connect_private_key=None, enable_mtls=False)
    control(publisher, inbox)
    assert arrived(inbox) == 2


def test_who_has_a_certificate_of_another_authority_is_not_let_in(
    secured: Bench, vehicle: Bus, predictor: Bus, tmp_path: Path
) -> None:
    publisher, inbox = vehicle.publisher(topics.EGO), predictor.inbox(topics.EGO)
    control(publisher, inbox)
    certificates.make(tmp_path, VEHICLE, DAY)
    foreign = BusSettings(connect=(secured.endpoint,), tls=TlsSettings.of(tmp_path / "vehicle"))
    assert refused(foreign), "it does not believe our router"
    assert refused(foreign, root_ca_certificate=str(secured.folder / "vehicle" / "ca.pem")), "it would, ours does not"
    control(publisher, inbox)
    assert arrived(inbox) == 2


def test_who_has_an_expired_certificate_is_not_let_in(secured: Bench, vehicle: Bus, predictor: Bus) -> None:
    publisher, inbox = vehicle.publisher(topics.EGO), predictor.inbox(topics.EGO)
    control(publisher, inbox)
    expired = secured.signed("vehicle.ego", expires=-DAY)
    assert refused(BusSettings(connect=(secured.endpoint,), tls=expired))
    valid = secured.signed("vehicle.ego")
    with session(BusSettings(connect=(secured.endpoint,), tls=valid)) as unexpired:  # else the same
        assert list(unexpired.info.routers_zid())
    control(publisher, inbox)


def test_who_expires_while_connected_is_cut_off(secured: Bench, predictor: Bus) -> None:
    inbox = predictor.inbox(topics.EGO)
    soon = secured.signed("vehicle.ego", expires=datetime.timedelta(seconds=2))
    with session(BusSettings(connect=(secured.endpoint,), tls=soon)) as leaving:
        until(lambda: put_raw(leaving, topics.EGO) or arrived(inbox), every_s=0.05, what="what it puts while valid")
        until(lambda: not list(leaving.info.routers_zid()), within_s=20, what="the end of its link")
        before = arrived(inbox)
        put_raw(leaving, topics.EGO)
    with secured.joined("vehicle") as rightful:
        control(rightful.publisher(topics.EGO), inbox)
    assert arrived(inbox) == before + 1


def test_plain_tcp_is_not_let_in(secured: Bench, vehicle: Bus, predictor: Bus) -> None:
    publisher, inbox = vehicle.publisher(topics.EGO), predictor.inbox(topics.EGO)
    control(publisher, inbox)
    assert refused(BusSettings(connect=(secured.endpoint.replace("tls/", "tcp/"),)))
    control(publisher, inbox)
    assert arrived(inbox) == 2


@pytest.mark.parametrize(
    "name", ["stranger", "vehicle", "vehicle.other", "planner.other", "vehicle.ego.x", "VEHICLE.EGO", "router.ego"]
)
def test_the_right_authority_but_another_name_gets_nothing_in_or_out(
    secured: Bench, vehicle: Bus, predictor: Bus, name: str
) -> None:
    publisher, inbox = vehicle.publisher(topics.EGO), predictor.inbox(topics.EGO)
    control(publisher, inbox)
    heard: list[Any] = []
    settings = BusSettings(connect=(secured.endpoint,), tls=secured.signed(name))
    # two sessions: what one says to itself never meets the router, and is no evidence
    with session(settings) as stranger, session(settings) as listener:
        assert list(stranger.info.routers_zid()), "it is connected: what stops it is its name"
        held = [listener.declare_subscriber(k, heard.append) for k in ("**", topics.key(VEHICLE, topics.EGO))]
        for _ in range(20):
            put_raw(stranger, topics.EGO)
            control(publisher, inbox)
        token = stranger.liveliness().declare_token(topics.alive_key(VEHICLE, "planner"))
        asked = [r for r in stranger.get(f"{topics.key(VEHICLE, topics.MAP)}/@adv/**", timeout=0.3) if r.ok]
        assert vehicle.alive() == set()
        del held, token
    assert arrived(inbox) == 21
    assert not heard and not asked


def test_a_token_is_shown_for_oneself_alone(secured: Bench, vehicle: Bus) -> None:
    with secured.joined("planner") as planner:
        planner.liveliness("riskfield")
        planner.liveliness("planner")
        until(lambda: vehicle.alive(), what="its own token")
        assert vehicle.alive() == {"planner"}


# --- what gets through ---


def test_a_planner_that_puts_risk_is_not_heard(secured: Bench) -> None:
    with secured.joined("planner") as planner, secured.joined("riskfield") as riskfield, secured.joined("viz") as viz:
        risks, plans = viz.inbox(topics.RISK), viz.inbox(topics.PLAN)
        rightful, own, forged = (
            riskfield.publisher(topics.RISK), planner.publisher(topics.PLAN), planner.publisher(topics.RISK)
        )  # fmt: skip
        control(rightful, risks)
        for _ in range(20):
            forged.put(message(topics.RISK), capture_ns=0)
            control(own, plans)
        control(rightful, risks)
        assert arrived(plans) == 20
        assert arrived(risks) == 2
        assert risks.take() is not None and risks.latest is not None and risks.latest.source == "riskfield"


def test_an_old_message_put_again_is_used_once_whoever_puts_it(secured: Bench, predictor: Bus) -> None:
    inbox = predictor.inbox(topics.EGO)
    first, second = raw(topics.EGO, boot="a" * 16, seq=5), raw(topics.EGO, boot="b" * 16)
    k = topics.key(VEHICLE, topics.EGO)
    used = 0
    with session(secured.settings("vehicle")) as opened, session(secured.settings("planner")) as thief:
        rightful = opened.declare_publisher(k)
        until(lambda: rightful.matching_status.matching, what="the reader")
        for n, (payload, header) in enumerate((first, first, second, first, second), start=1):
            thief.put(k, payload, attachment=header)
            rightful.put(payload, attachment=header)
            until(lambda n=n: arrived(inbox) >= n, what="the rightful copy")
            used += inbox.take() is not None
        assert arrived(inbox) == 5, "none of the thief's"
    assert used == 2, "each message once"
    assert predictor.counters == {"ego:duplicate": 2, "ego:old_boot": 1}


def test_the_map_is_latched_for_a_late_joiner_over_the_secured_router_too(secured: Bench, vehicle: Bus) -> None:
    vehicle.publisher(topics.MAP).put(samples.world(), capture_ns=0)
    with secured.joined("planner") as late:
        inbox = late.inbox(topics.MAP)
        until(inbox.take, what="the latched map")
        route = late.inbox(topics.ROUTE)
        vehicle.publisher(topics.ROUTE).put(samples.route(), capture_ns=0)
        until(route.take, what="the route of a late publisher")


def test_what_is_larger_than_its_topic_allows_stops_at_the_router(secured: Bench, predictor: Bus) -> None:
    inbox = predictor.inbox(topics.EGO)
    k = topics.key(VEHICLE, topics.EGO)
    payload, header = raw(topics.EGO)
    with session(secured.settings("vehicle")) as opened:
        sender = opened.declare_publisher(k)
        until(lambda: sender.matching_status.matching, what="the reader")
        for _ in range(2):
            sender.put(bytes(topics.EGO.max_bytes + topics.EGO.max_header_bytes + 1), attachment=header)
            sender.put(payload, attachment=header)
        until(lambda: arrived(inbox) >= 2, what="those of the right size")
        assert arrived(inbox) == 2
    assert "ego:too_large" not in predictor.counters


# --- whom the clients believe ---


@pytest.mark.parametrize("fault", ["another name", "a client's certificate"])
def test_a_client_does_not_speak_with_a_router_that_is_not_who_it_says(secured: Bench, fault: str) -> None:
    tls = (
        secured.signed("router.ego", hosts=("elsewhere",))
        if fault == "another name"
        else TlsSettings.of(secured.folder / "planner")
    )
    with router(settings=BusSettings(tls=tls), secured=Secured((VEHICLE,))) as endpoint:
        assert refused(secured.settings("vehicle", endpoint))
    honest = BusSettings(tls=secured.signed("router.ego", hosts=("127.0.0.1",)))
    with (
        router(settings=honest, secured=Secured((VEHICLE,))) as endpoint,
        session(secured.settings("vehicle", endpoint)) as opened,
    ):
        assert list(opened.info.routers_zid())


def test_the_secured_router_tells_nobody_where_it_is_and_has_no_other_door(secured: Bench) -> None:
    with open_bus(secured.settings("vehicle"), VEHICLE, "vehicle", wait_s=20):
        lonely = zenoh.Config.from_json5('{"mode": "client", "scouting": {"timeout": 500}}')
        with pytest.raises(zenoh.ZError):
            zenoh.open(lonely)


# --- settings ---


def test_the_printed_configuration_makes_the_same_router_elsewhere(
    secured: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """For those who run Eclipse's `zenohd` instead of our router."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    folder = str(secured.folder / "router")
    assert router_main(["--secure", folder, "--vehicle", VEHICLE, "--listen", endpoint, "--print"]) == 0
    file = tmp_path / "zenohd.json5"
    file.write_text(capsys.readouterr().out)
    with (
        zenoh.open(zenoh.Config.from_file(str(file))),
        open_bus(secured.settings("vehicle", endpoint), VEHICLE, "vehicle", wait_s=20) as vehicle,
        open_bus(secured.settings("planner", endpoint), VEHICLE, "planner", wait_s=20) as planner,
        open_bus(secured.settings("viz", endpoint), VEHICLE, "viz", wait_s=20) as viz,
    ):
        egos = viz.inbox(topics.EGO)
        control(vehicle.publisher(topics.EGO), egos)
        planner.publisher(topics.EGO).put(samples.ego(), capture_ns=0)
        control(vehicle.publisher(topics.EGO), egos)
        assert arrived(egos) == 2


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"connect": ("tcp/127.0.0.1:1",), "tls": {"ca": "x", "certificate": "y", "key": "z"}}, "begins with tls/"),
        ({"connect": ("tls/127.0.0.1:1",)}, "needs bus.tls.ca"),
        ({"connect": ("tls/127.0.0.1:1",), "tls": {"ca": "/nowhere"}}, "bus.tls.ca: /nowhere: no such file"),
        ({"connect": ("tls/127.0.0.1:1",), "tls": {"key": "/nowhere"}}, "bus.tls.ca is missing"),
    ],
)
def test_a_security_setting_is_never_left_out_in_silence(settings: dict[str, Any], words: str) -> None:
    tls = TlsSettings(**settings.get("tls", {}))
    with (
        pytest.raises(ConfigError, match=words),
        open_bus(BusSettings(connect=settings["connect"], tls=tls), VEHICLE, "x", wait_s=0.0),
    ):
        pass


def test_a_router_without_certificates_cannot_be_called_secured() -> None:
    with pytest.raises(ConfigError, match="certificates"), router(secured=Secured((VEHICLE,))):
        pass


def test_giving_up_on_a_router_that_does_not_let_us_in_is_possible(secured: Bench) -> None:
    expired = BusSettings(connect=(secured.endpoint,), tls=secured.signed("vehicle.ego", expires=-DAY))
    with pytest.raises(NoRouterError), open_bus(expired, VEHICLE, "vehicle", wait_s=0.2):
        pass
