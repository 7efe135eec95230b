"""The command that measures the risk field: bench riskfield."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from rig.exits import exits, writable, write
from rig.options import Json


def register(bench: typer.Typer) -> None:
    """Add the command to the benchmarks."""
    bench.command("riskfield")(bench_riskfield)


def bench_riskfield(
    frames: Annotated[
        str, typer.Option("--frames", help="Which frames, of standard, dense, fine.", metavar="NAME,...")
    ] = "standard,dense,fine",
    json_: Json = None,
    rounds: Annotated[int, typer.Option("--rounds", help="Runs of each slow rival.", min=1)] = 5,
    scaling: Annotated[
        bool, typer.Option("--scaling/--no-scaling", help="Measure time against road users and area too.")
    ] = True,
    device: Annotated[str, typer.Option("--device", help="Where ours runs.", metavar="cpu|cuda|auto")] = "cpu",
) -> None:
    """How fast is the risk field? Beside NumPy, a plain Warp kernel, numba and memset, in one interleaved run."""
    from evaluation import bench_riskfield as measuring

    with exits():
        writable("--json", json_)
        names = [name.strip() for name in frames.split(",") if name.strip()]
        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            result = measuring.measure(names, rounds=rounds, device=device, scaling=scaling, progress=progress)
        if json_ is not None:
            write(json_, result)
        for part in measuring.table(result):
            Console().print(part)
