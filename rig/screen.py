"""What is seen while a run goes on: a live line of figures on a terminal, elsewhere a line as each phase begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from rig.exits import say
from rig.live import Moment

COLOURS = {"drive": "green", "waiting": "yellow", "safe_stop": "red"}


@contextmanager
def progress(console: Console, title: str) -> Iterator[Callable[[Moment], None]]:
    """Give a function that shows a moment; where there is no terminal it prints no more than each phase's beginning."""
    if not console.is_terminal:
        begun: list[str] = []

        def tell(moment: Moment) -> None:
            if moment.phase not in begun:
                begun.append(moment.phase)
                say(escape(f"{title}: {moment.phase}"))

        yield tell
        return
    with Live(f"{escape(title)}: starting router and services …", console=console, refresh_per_second=4) as live:
        yield lambda moment: live.update(_row(title, moment))


def _row(title: str, m: Moment) -> Table:
    out = Table.grid(padding=(0, 2))
    mode = "no plan" if m.plan is None else m.plan.mode
    risk = None if m.plan is None or m.plan.slice_risk is None else m.plan.slice_risk.risk
    where = f"{m.t:5.1f} of {m.duration_s:.1f} s" if m.phase == "run" else m.phase
    out.add_row(
        f"[bold]{escape(title)}[/]",
        where,
        f"[{COLOURS.get(mode, 'yellow')}]{mode.replace('_', ' ')}[/]",
        f"{m.ego.speed:4.1f} m/s",
        "risk  –  " if risk is None or not len(risk) else f"risk {float(risk.max()):4.2f}",
        "" if m.end_to_end_ms is None else f"{m.end_to_end_ms:3.0f} ms end to end",
    )
    reason = "" if m.plan is None else (m.plan.decision.sentence if m.plan.decision else m.plan.reason)
    frame = Table.grid()
    frame.add_row(out)
    frame.add_row(f"[dim]{escape(reason[:110])}[/]")
    return frame
