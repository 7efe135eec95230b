"""Quick form of row 9: two hosts, the cable between them cut for a second."""

from __future__ import annotations

import pytest

from evaluation.faults.network import second_host
from evaluation.faults.result import FaultError
from evaluation.faults.row_09_partition import cut
from evaluation.faults.stack import stack


def test_a_cut_between_two_hosts_is_a_safe_stop_and_the_healed_link_drives_again() -> None:
    try:
        with second_host():
            pass
    except FaultError as e:
        pytest.skip(str(e))
    with second_host() as cable:
        assert cable.reaches()
        with stack(names=("planner",), drive=False, upstream=cable.endpoint, road_users=12) as s:
            s.start("edge", "--listen", cable.endpoint, within=cable.within)
            for service in ("predictor", "riskfield"):
                s.start(service, within=cable.within, settings={"bus.connect": [cable.endpoint]})
            s.settle(0.3, 120.0)
            back = cut(s, cable, 1.0)
            assert back.stop_ms > 0 and back.out_s >= 1.0
            s.check()
