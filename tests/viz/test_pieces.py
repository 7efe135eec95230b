"""A recording is cut into pieces that stay within their limits, and only pieces are ever removed."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common import config
from common.config import ConfigError
from viz import pieces as pieces_module
from viz.pieces import Limits, NoRoomError, Pieces, size
from viz.settings import VizSettings

NOW = datetime(2026, 1, 31, 12, tzinfo=UTC)
ANY = Limits(piece_bytes=0, piece_s=0.0, budget_bytes=0, reserve_bytes=0)


def fill(path: Path, n: int) -> None:
    path.write_bytes(b"x" * n)


def limited(piece: int = 1000, budget: int = 5000, reserve: int = 0) -> Limits:
    return Limits(piece_bytes=piece, piece_s=60.0, budget_bytes=budget, reserve_bytes=reserve)


def test_the_first_piece_has_the_name_that_was_asked_for(tmp_path):
    pieces = Pieces.of(str(tmp_path / "a.rrd"), ANY)
    assert [pieces.begin().name for _ in range(3)] == ["a.rrd", "a.0002.rrd", "a.0003.rrd"]


def test_in_a_folder_nothing_is_overwritten_even_by_processes_of_one_second(tmp_path):
    names = []
    for _ in range(3):
        pieces = Pieces.of(str(tmp_path), ANY, NOW)
        for _ in range(2):
            path = pieces.begin()
            assert not path.exists()
            fill(path, 10)
            names.append(path.name)
    assert len(set(names)) == 6 and all(
        re.fullmatch(r"forefield-20260131T120000Z(-\d)?-000[12]\.rrd", n) for n in names
    )


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 1500), min_size=1, max_size=40), st.integers(1, 6))
def test_whatever_the_pieces_sizes_a_budget_holds_and_the_newest_stay(tmp_path_factory, sizes, pieces_in_budget):
    folder = tmp_path_factory.mktemp("budget")
    other = folder / "notes.rrd"
    fill(other, 9000)
    budget = 1500 * pieces_in_budget
    pieces = Pieces.of(str(folder), limited(1500, budget), NOW)
    written = []
    for n in sizes:
        path = pieces.begin()
        fill(path, n)
        written.append(path)
        pieces.make_room(path)
        kept = pieces.kept()
        assert sum(map(size, kept)) <= budget
        assert kept == written[len(written) - len(kept) :]
    assert size(other) == 9000


def test_what_earlier_processes_left_in_the_folder_goes_first(tmp_path):
    old = tmp_path / "forefield-20250101T000000Z-0009.rrd"
    fill(old, 4000)
    pieces = Pieces.of(str(tmp_path), limited(), NOW)
    fill(pieces.begin(), 900)
    assert old.exists()
    pieces.begin()
    assert not old.exists() and len(pieces.kept()) == 1


def test_a_cut_never_removes_the_piece_that_is_still_written(tmp_path):
    """At a cut rows go into the old piece until the next one is open, however small the budget is."""
    for target in (tmp_path / "a.rrd", tmp_path):
        pieces = Pieces.of(str(target), limited(piece=1000, budget=1500), NOW)
        for _ in range(4):
            path = pieces.begin()
            fill(path, 1000)
            following = pieces.begin()
            assert path.exists()
            fill(following, 1000)
            assert pieces.make_room(following) == [path]  # it is finished by now


class Disk:
    """`free` bytes, taken by others; what is removed is freed at its size, or not at all."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, free: int, frees: bool = True) -> None:
        self.free, self.frees = free, frees
        unlink = Path.unlink

        def removed(path: Path, missing_ok: bool = False) -> None:
            self.free += size(path) if self.frees else 0
            unlink(path, missing_ok)

        monkeypatch.setattr(pieces_module, "_free", lambda _: self.free)
        monkeypatch.setattr(Path, "unlink", removed)


def drive(folder: Path, n: int, limits: Limits) -> tuple[Pieces, list[Path]]:
    pieces = Pieces.of(str(folder), limits, NOW)
    written = []
    for _ in range(n):
        written.append(pieces.begin())
        fill(written[-1], 1000)
    return pieces, written


@given(st.integers(1, 6), st.integers(0, 9000))
def test_a_disk_that_others_fill_costs_no_piece_unless_that_helps(tmp_path_factory, n, free):
    folder = tmp_path_factory.mktemp("full")
    pieces, written = drive(folder, n, limited(budget=0))
    pieces.limits = limited(budget=0, reserve=8000)
    with pytest.MonkeyPatch.context() as monkeypatch:
        disk = Disk(monkeypatch, free)
        enough = free + 1000 * (n - 1) >= 8000
        for again in range(3):  # while it is written, and then at each attempt to go on
            try:
                pieces.make_room(written[-1]) if again == 0 else pieces.begin()
                assert enough
            except NoRoomError:
                assert not enough
        left = pieces.kept()
    assert left == written[n - len(left) :] and written[-1] in left
    assert disk.free >= 8000 if enough else left == written


def test_a_removal_that_frees_nothing_is_the_last(tmp_path, monkeypatch):
    pieces, written = drive(tmp_path, 5, limited(budget=0))
    Disk(monkeypatch, free=7000, frees=False)
    pieces.limits = limited(budget=0, reserve=8000)
    with pytest.raises(NoRoomError, match="freed nothing"):
        pieces.begin()
    assert pieces.kept() == written[1:]


def test_a_budget_without_room_for_two_pieces_is_refused_and_both_ways_out_are_named():
    with pytest.raises(ConfigError, match=r"viz\.budget_mib is 1500.*raise it to 2048.*viz\.rotate_mib=750"):
        config.section({"viz": {"budget_mib": 1500.0}}, "viz", VizSettings)
    config.section({"viz": {"budget_mib": 2048.0}}, "viz", VizSettings)
    config.section({"viz": {"budget_mib": 0.0}}, "viz", VizSettings)
    config.section({"viz": {"budget_mib": 10.0, "rotate_mib": 0.0}}, "viz", VizSettings)


def test_beside_a_file_only_what_this_process_wrote_is_removed(tmp_path):
    for name in ("a.0007.rrd", "b.rrd"):
        fill(tmp_path / name, 10_000)
    pieces = Pieces.of(str(tmp_path / "a.rrd"), limited())
    for _ in range(12):
        fill(pieces.begin(), 1000)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"a.0007.rrd", "b.rrd"} <= names and "a.rrd" not in names and "a.0013.rrd" in names
    assert size(tmp_path / "a.0007.rrd") == 10_000


def test_a_disk_without_room_is_named_and_the_piece_being_written_is_never_removed(tmp_path):
    pieces = Pieces.of(str(tmp_path / "a.rrd"), limited(reserve=2**62))
    with pytest.raises(NoRoomError, match=r"viz\.reserve_mib"):
        pieces.begin()
    pieces = Pieces.of(str(tmp_path / "a.rrd"), limited(budget=500))
    path = pieces.begin()
    fill(path, 1000)
    with pytest.raises(NoRoomError, match="the budget is"):
        pieces.make_room(path)
    assert path.exists()


def test_a_piece_is_full_by_size_or_by_age(tmp_path):
    pieces = Pieces.of(str(tmp_path / "a.rrd"), limited())
    path = pieces.begin()
    fill(path, 999)
    assert not pieces.is_full(path, 59.0) and pieces.is_full(path, 60.0)
    fill(path, 1000)
    assert pieces.is_full(path, 0.0)
    assert not Pieces.of(str(path), ANY).is_full(path, 1e9)
