"""Progress of long work: bars with the time to go on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TimeRemainingColumn

from rig.exits import say

EVERY_S = 15.0
"""Lines are not closer than this [s], but for the first and the last of each kind of work."""

Tell = Callable[[str, int, int], None]
"""What is being done, how much of it is done, of how much."""


@contextmanager
def working(console: Console | None = None) -> Iterator[Tell]:
    """Give a function that is told how far the work is; everything goes to stderr."""
    console = console or Console(stderr=True)
    if not console.is_terminal:
        yield lines()
        return
    bars: dict[str, int] = {}
    with Progress(*Progress.get_default_columns()[:-1], TimeRemainingColumn(), console=console) as progress:

        def tell(what: str, done: int, whole: int) -> None:
            if what not in bars:
                bars[what] = progress.add_task(escape(what), total=whole)
            progress.update(bars[what], completed=done, total=whole)  # type: ignore[arg-type]

        yield tell


def lines(clock: Callable[[], float] = time.monotonic, write: Callable[[str], None] = say) -> Tell:
    """A function that writes a line now and then."""
    begun: dict[str, tuple[float, int]] = {}
    last: dict[str, float] = {}

    def tell(what: str, done: int, whole: int) -> None:
        now = clock()
        begin, before = begun.setdefault(what, (now, done))
        if what in last and done < whole and now - last[what] < EVERY_S:
            return
        last[what] = now
        done_now = done - before
        to_go = f", {(now - begin) / done_now * (whole - done):.0f} s to go" if done_now > 0 and done < whole else ""
        write(escape(f"{what}: {done} of {whole}{to_go}"))

    return tell
