"""Rows to a terminal, to JSON, and into docs/safety.md between two markers."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from evaluation.faults.result import Figure, Row

BEGIN = "<!-- faults: begin (written by `make faults`) -->"
END = "<!-- faults: end -->"


@dataclass(frozen=True)
class Entry:
    """A row as it was run: its result or its error, when, how, and how still the machine was."""

    number: int
    row: Row | None
    error: str
    mode: str
    """`faults`, `faults-full`, or `smoke`."""
    seed: int
    commit: str
    date: str
    took_s: float
    timer_ms: float
    """Worst gap of a bare 20 Hz timer beside it [ms]."""
    others: float
    """Share of the cores that processes which are not ours used meanwhile."""

    @property
    def good(self) -> bool:
        """Whether its target was reached."""
        return self.row is not None and self.row.reached

    @property
    def verdict(self) -> str:
        """In a word."""
        return "error" if self.row is None else "reached" if self.row.reached else "NOT reached"


def text(value: Figure) -> str:
    """A figure with as many digits as it deserves."""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return str(value)


def figures(entry: Entry) -> list[str]:
    """`name value unit` of each figure; names end with their unit in brackets."""
    if entry.row is None:
        return [f"error: {entry.error}"]
    lines = []
    for name, value in entry.row.figures.items():
        bare, _, unit = name.removesuffix("]").partition(" [")
        lines.append(f"{bare}: {text(value)}{' ' + unit if unit else ''}")
    return lines


def terminal(entries: list[Entry]) -> Table:
    """The table for a terminal."""
    out = Table(title="Faults", title_justify="left", show_lines=True)
    for name in ("#", "fault", "to reach", "figures", "proof", "", "timer ms", "others", "s"):
        out.add_column(name, overflow="fold", justify="right" if name in ("#", "timer ms", "others", "s") else "left")
    for e in entries:
        fault, target, proof, why = (e.row.fault, e.row.target, e.row.proof, e.row.why) if e.row else ("", "", "", "")
        verdict = f"[{'green' if e.good else 'red'}]{e.verdict}[/]{': ' + why if why else ''}"
        out.add_row(
            str(e.number), fault, target, "\n".join(figures(e)), proof, verdict, f"{e.timer_ms:.0f}", f"{e.others:.0%}",
            f"{e.took_s:.0f}",
        )  # fmt: skip
    return out


def markdown(entries: list[Entry]) -> str:
    """The table for the documents, and how it was made."""
    lines = [
        "| # | fault | to reach | measured | proof that it happened | reached | timer; others |",
        "|---|---|---|---|---|---|---|",
    ]
    for e in entries:
        fault, target, proof = (e.row.fault, e.row.target, e.row.proof) if e.row else ("", "", "")
        reached = ("**yes**" if e.good else f"**no**: {e.row.why}") if e.row else "**error**"
        cells = (
            str(e.number),
            fault,
            target,
            "; ".join(figures(e)),
            proof,
            reached,
            f"{e.timer_ms:.0f} ms; {e.others:.0%}",
        )
        lines.append("| " + " | ".join(_cell(c) for c in cells) + " |")
    runs: dict[tuple[str, str, str], list[int]] = {}
    for e in entries:
        runs.setdefault((e.mode, e.commit, e.date[:10]), []).append(e.number)
    lines.append("")
    for (mode, commit, day), numbers in runs.items():
        seeds = sorted({e.seed for e in entries if (e.mode, e.commit, e.date[:10]) == (mode, commit, day)})
        lines.append(
            f"Rows {', '.join(map(str, sorted(numbers)))}: `make {mode}`, commit {commit}, {day},"
            f" seed {', '.join(map(str, seeds))}, {sum(e.took_s for e in entries if e.number in numbers):.0f} s."
        )
    return "\n".join(lines)


def _cell(value: str) -> str:
    return value.replace("|", "\\|").replace("\n", " ")


def to_json(entries: list[Entry]) -> str:
    """Entries as JSON, one a row."""
    return json.dumps([asdict(e) for e in entries], indent=1, ensure_ascii=False) + "\n"


def from_json(content: str) -> list[Entry]:
    """Read entries.

    Raises:
        ValueError: it is no such file.
    """
    try:
        return [_entry(e) for e in json.loads(content)]
    except (TypeError, KeyError, AttributeError) as e:
        raise ValueError(f"not a table of faults: {e}") from None


def _entry(fields: dict[str, Any]) -> Entry:
    row = fields["row"]
    return Entry(**{**fields, "row": None if row is None else Row(**row)})


def merged(before: list[Entry], now: list[Entry]) -> list[Entry]:
    """The newest entry of each row, in order."""
    return [e for _, e in sorted({e.number: e for e in (*before, *now)}.items())]


def into(document: Path, content: str) -> None:
    """Put the table between the markers of a document.

    Raises:
        ValueError: the document has no markers.
    """
    old = document.read_text()
    head, begin, rest = old.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{document}: no markers {BEGIN!r} and {END!r}")
    document.write_text(f"{head}{BEGIN}\n{content}\n{END}{tail}")
