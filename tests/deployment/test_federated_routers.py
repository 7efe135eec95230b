"""A vehicle's router joined to one at the edge: what is said on one side is heard on the other, and no more."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path

import pytest

from common import topics
from common.bus import Bus, BusSettings, free_port, open_bus, router
from common.bus_config import Secured, TlsSettings
from common.clock import monotonic
from rig import certificates
from tests import samples
from tests.security.bench import DAY, VEHICLE, arrived, control
from tests.waiting import until

EDGE = "edge"


class Site:
    """Certificates of the vehicle and of the edge, or none, and how one joins a router with them."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        if folder is not None:  # as docs/deployment.md says it
            certificates.make(folder / EDGE, EDGE, DAY / 2)
            certificates.make(folder / VEHICLE, VEHICLE, DAY / 2, ca=folder / EDGE / "ca")

    @property
    def protocol(self) -> str:
        return "tls" if self.folder else "tcp"

    def settings(self, role: str, endpoint: str = "", of: str = VEHICLE) -> BusSettings:
        tls = TlsSettings.of(self.folder / of / role) if self.folder else TlsSettings()
        return BusSettings(connect=(endpoint,), tls=tls)

    def edge(self, *named: str, listen: str = "") -> AbstractContextManager[str]:
        secured = Secured((VEHICLE,), named) if self.folder else None
        return router(settings=self.settings("router", of=EDGE), secured=secured, listen=listen)

    def car(self, upstream: str) -> AbstractContextManager[str]:
        secured = Secured((VEHICLE,), (EDGE,)) if self.folder else None
        return router(settings=self.settings("router"), secured=secured, upstream=[upstream])

    @contextmanager
    def joined(self, role: str, endpoint: str) -> Iterator[Bus]:
        with open_bus(self.settings(role, endpoint), VEHICLE, role, wait_s=20) as bus:
            yield bus


@pytest.fixture(params=["open", "secured"])
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Site:
    return Site(None if request.param == "open" else tmp_path)


def test_both_sides_hear_each_other_and_the_late_get_what_is_latched(site: Site) -> None:
    with ExitStack() as stack:
        edge = stack.enter_context(site.edge(VEHICLE))
        car = stack.enter_context(site.car(edge))
        vehicle = stack.enter_context(site.joined("vehicle", car))
        vehicle.publisher(topics.MAP).put(samples.world(), capture_ns=monotonic())
        planner = stack.enter_context(site.joined("planner", edge))
        control(vehicle.publisher(topics.EGO), planner.inbox(topics.EGO))
        control(planner.publisher(topics.PLAN), vehicle.inbox(topics.PLAN))
        until(planner.inbox(topics.MAP).take, what="the map, latched on the other side")
        planner.liveliness("planner")
        until(lambda: vehicle.alive() == {"planner"}, what="the token")


def test_a_router_that_is_not_named_passes_nothing_on(tmp_path: Path) -> None:
    site = Site(tmp_path)
    with ExitStack() as stack:
        edge = stack.enter_context(site.edge())
        car = stack.enter_context(site.car(edge))
        there, here = (
            stack.enter_context(site.joined("vehicle", car)),
            stack.enter_context(site.joined("vehicle", edge)),
        )
        beside, beyond = (stack.enter_context(site.joined("planner", e)) for e in (car, edge))
        near, far = beside.inbox(topics.EGO), beyond.inbox(topics.EGO)
        passed_on, direct = there.publisher(topics.EGO), here.publisher(topics.EGO)
        for _ in range(10):
            control(passed_on, near)
            control(direct, far)
        assert arrived(far) == 10, "only what was said at the edge itself"
        assert arrived(near) == 10


def test_the_edge_may_come_later_and_may_come_back(site: Site) -> None:
    endpoint = f"{site.protocol}/127.0.0.1:{free_port()}"
    with ExitStack() as stack:
        car = stack.enter_context(site.car(endpoint))
        vehicle = stack.enter_context(site.joined("vehicle", car))
        ego = vehicle.publisher(topics.EGO)
        beside = stack.enter_context(site.joined("planner", car)).inbox(topics.EGO)
        control(ego, beside)  # the vehicle does not wait for the edge
        for _ in range(2):
            with (
                site.edge(VEHICLE, listen=endpoint),
                site.joined("viz", endpoint) as watcher,
            ):
                inbox = watcher.inbox(topics.EGO)

                def heard(inbox: object = inbox) -> bool:
                    ego.put(samples.ego(), capture_ns=monotonic())
                    return arrived(inbox) > 0  # type: ignore[arg-type]

                until(heard, within_s=20, every_s=0.05, what="the ego at the edge")
            before = arrived(beside)
            ego.put(samples.ego(), capture_ns=monotonic())
            until(lambda b=before: arrived(beside) > b, what="the ego beside, with the edge gone")
