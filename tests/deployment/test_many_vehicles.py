"""Twenty vehicles on one router: everyone is heard, nobody hears another's."""

from __future__ import annotations

from tests.deployment import fleet


def test_twenty_vehicles_share_a_router_and_none_hears_anothers() -> None:
    result = fleet.measure(vehicles=20, seconds=1.0)
    offered = sum(result["sent"].values())
    assert offered == 20 * (50 + 10 + 20)
    assert result["foreign"] == 0
    assert result["lost"] <= 0.1 * offered, "a busy machine may drop, a router that cannot carry them would lose most"
