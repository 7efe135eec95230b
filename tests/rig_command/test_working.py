"""Where there is no terminal, long work tells how far it is and how long it still takes, but not all the time."""

from __future__ import annotations

from rig.working import EVERY_S, lines


def test_lines_come_now_and_then_with_the_time_to_go():
    now, said = [0.0], []
    tell = lines(clock=lambda: now[0], write=said.append)
    for k in range(101):
        tell("windows", k, 100)
        now[0] += EVERY_S / 5
    assert said[0] == "windows: 0 of 100"
    assert said[1] == f"windows: 5 of 100, {EVERY_S / 5 * 95:.0f} s to go"
    assert said[-1] == "windows: 100 of 100" and len(said) == 21


def test_every_kind_of_work_counts_for_itself():
    said = []
    tell = lines(clock=lambda: 0.0, write=said.append)
    tell("one", 1, 1)
    tell("two [of them]", 0, 3)
    assert said == ["one: 1 of 1", "two \\[of them]: 0 of 3"]
