"""The table: what was run replaces its own rows alone, an error is never a success, a row without proof is an error."""

from __future__ import annotations

from pathlib import Path

import pytest

from evaluation.faults import __main__ as command
from evaluation.faults.process import Sample, drift, growth_mib
from evaluation.faults.result import FaultError, Row, Scale, Verdict
from evaluation.faults.table import BEGIN, END, Entry, figures, from_json, into, markdown, merged, to_json


def entry(number: int, reached: bool = True, mode: str = "faults", error: str = "") -> Entry:
    row = Row(
        number, "f|ault", "target", {"gap p99.9 [ms]": 61.23, "missed": 0}, "5 of 5", reached, "" if reached else "x"
    )
    return Entry(number, None if error else row, error, mode, 7, "abc", "2026-01-02T03:04:05", 1.5, 52.0, 0.01)


def test_a_row_without_proof_is_an_error() -> None:
    with pytest.raises(FaultError):
        Verdict().row(1, "f", "t", {}, "")


def test_a_row_is_reached_only_if_nothing_was_missed_and_says_what_was() -> None:
    verdict = Verdict()
    verdict.need(True, "no")
    assert verdict.row(1, "f", "t", {}, "p").reached
    verdict.need(not (float("nan") <= 5.0), "never")
    verdict.need(float("nan") <= 5.0, "gap nan ms")
    row = verdict.row(1, "f", "t", {}, "p")
    assert not row.reached and row.why == "gap nan ms"


def test_entries_survive_their_file_and_the_newest_of_each_row_counts() -> None:
    old, new = [entry(1), entry(2, reached=False)], [entry(2, mode="faults-full"), entry(3, error="no")]
    assert from_json(to_json(old)) == old
    both = merged(old, new)
    assert [(e.number, e.mode, e.good) for e in both] == [
        (1, "faults", True), (2, "faults-full", True), (3, "faults", False),
    ]  # fmt: skip
    assert [e.verdict for e in (*old, *new)] == ["reached", "NOT reached", "reached", "error"]


@pytest.mark.parametrize("content", ["{}x", '[{"row": null}]', "[3]", '{"a": 1}'])
def test_another_file_is_refused(content: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        from_json(content)


def test_figures_stand_with_their_units() -> None:
    assert figures(entry(1)) == ["gap p99.9: 61.2 ms", "missed: 0"]
    assert figures(entry(1, error="broken")) == ["error: broken"]


def test_the_document_keeps_everything_outside_of_its_markers(tmp_path: Path) -> None:
    document = tmp_path / "safety.md"
    document.write_text(f"# Before\n{BEGIN}\nold\n{END}\nafter\n")
    into(document, markdown([entry(1), entry(2, reached=False), entry(3, error="broken")]))
    text = document.read_text()
    assert text.startswith(f"# Before\n{BEGIN}\n| #") and text.endswith(f"{END}\nafter\n")
    assert "old" not in text and "f\\|ault" in text and "**no**: x" in text and "error: broken" in text
    assert "Rows 1, 2, 3: `make faults`, commit abc, 2026-01-02, seed 7" in text
    document.write_text("no markers")
    with pytest.raises(ValueError, match="markers"):
        into(document, "x")


def test_a_row_that_raises_is_an_error_with_its_reason_and_the_scale_decides_the_counts() -> None:
    def broken(scale: Scale, seed: int, say: object) -> Row:
        assert (scale.repetitions(5, 100, 1), scale.seconds(60.0, 3600.0, 2.0)) == (1, 2.0)
        raise FaultError(f"seed {seed}")

    found = command.entry(99, broken, Scale(smoke=True), 3, print)
    assert (found.row, found.error, found.good, found.mode) == (None, "seed 3", False, "smoke")
    assert (Scale().repetitions(5, 100), Scale(full=True).repetitions(5, 100)) == (5, 100)


def test_every_row_of_the_issue_is_known() -> None:
    assert set(command.rows()) <= set(range(1, 19))
    assert {1, 2, 3, 4, 9, 11, 13, 15, 16} <= set(command.rows())


def test_growth_is_the_trend_and_not_one_jump() -> None:
    flat = [Sample(float(t), 100.0 + (50.0 if t == 30 else 0.0), 10, 5) for t in range(60)]
    rising = [Sample(float(t), 100.0 + 0.1 * t, 10, 5) for t in range(60)]
    assert growth_mib(flat) == 0.0
    assert growth_mib(rising) == pytest.approx(5.9)
    assert growth_mib(flat[:1]) == 0.0
    assert (drift([5, 6, 5, 5, 7, 5, 5, 5, 5, 5]), drift(list(range(10)))) == (0, 8)


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 2, 3, 4, 9, 11, 13, 15, 16])
def test_a_whole_row_runs_and_proves_its_fault(number: int) -> None:
    try:
        row = command.rows()[number](Scale(smoke=True), 1, print)
    except FaultError as e:
        if "namespaces" in str(e):
            pytest.skip(str(e))
        raise
    assert row.number == number and row.proof and row.figures
