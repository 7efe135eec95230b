"""The commands of prediction: train, eval prediction, eval ablation, generate traffic, bench predictor.

What they need beyond the bench (matplotlib, Eclipse SUMO) is imported only by the command that needs it.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_args

import typer
from rich.console import Console

from common import config
from common.config import ConfigError
from common.risk import RiskParameters
from rig import configuration
from rig.exits import exits, say, writable, write
from rig.options import Config, Json, Sets, evaluations
from rig.settings import RigSettings
from rig.working import working
from services.predictor.settings import Policy, PredictorSettings

Files = Annotated[list[str] | None, typer.Argument(help="More files.", show_default=False)]
Tracks = Annotated[
    list[str] | None,
    typer.Option("--tracks", help="Trajectory tables (csv or csv.gz).", metavar="FILES …", show_default=False),
]
Stride = Annotated[int, typer.Option("--stride", help="Frames between windows.", min=1, max=100)]
Seed = Annotated[int, typer.Option("--seed", min=0)]
Steps = Annotated[int, typer.Option("--steps", help="Steps of training.", min=1)]
Hidden = Annotated[int, typer.Option("--hidden", help="Hidden units.", min=1, max=1024)]
HoldOut = Annotated[
    list[str] | None,
    typer.Option("--hold-out", help="Site (file name) that is not trained on; may be repeated.", metavar="SITE"),
]
TorchDevice = Annotated[str, typer.Option("--device", help="Where to train.", metavar="cpu|cuda")]
WIDTH = 118
"""Narrower tables would cut the figures off."""
Group = Literal[
    "all", "moving", "vehicle_moving", "pedestrian_moving", "cycle_moving",
    "vehicle_stopped", "pedestrian_stopped", "cycle_stopped",
]  # fmt: skip
Method = Literal["paper", "learned-first", "learned-on-lanes", "map-first", "kinematic"]
assert get_args(Method) == get_args(Policy)


def register(app: typer.Typer, bench: typer.Typer) -> None:
    """Add the commands to the program and its benchmarks."""
    train = typer.Typer(help="Training.", no_args_is_help=True)
    train.command("predictor")(train_predictor)
    evaluation = evaluations(app)
    evaluation.command("prediction")(eval_prediction)
    evaluation.command("ablation")(eval_ablation)
    generate = typer.Typer(help="Generated data.", no_args_is_help=True)
    generate.command("traffic")(generate_traffic)
    app.add_typer(train, name="train")
    app.add_typer(generate, name="generate")
    bench.command("predictor")(bench_predictor)


def train_predictor(
    out: Annotated[Path, typer.Option("--out", help="Folder of weights; checkpoints in it are resumed.")],
    tracks: Tracks = None,
    more: Files = None,
    hold_out: HoldOut = None,
    networks: Annotated[
        str, typer.Option("--networks", help="Names, comma separated; the first is the default.")
    ] = "lstm_no_risk,lstm,lstm_no_attention,lstm_no_leader,lstm_paper",
    hidden: Hidden = 32,
    steps: Steps = 1000,
    seed: Seed = 0,
    stride: Stride = 5,
    recorded_share: Annotated[float, typer.Option("--recorded-share", help="Of each batch.", min=0.0, max=1.0)] = 0.2,
    shrink: Annotated[
        tuple[float, float], typer.Option("--shrink", help="Of the residual, in the city and on fast roads.")
    ] = (1.0, 0.9),
    note: Annotated[str, typer.Option("--note", help="Said in the card, such as how a table was generated.")] = "",
    device: TorchDevice = "cpu",
) -> None:
    """Train the predictor on trajectory tables and write a folder of weights with its model card."""
    with _exits():
        from evaluation import train_predictor as training
        from evaluation.training import Options

        _device(device)
        wanted = training.plans([n.strip() for n in networks.split(",") if n.strip()], hidden, steps)
        files = _files("--tracks", tracks, more)
        with working() as tell:
            data = training.read(files, hold_out or [], RiskParameters(), stride, tell)
        say(
            f"{len(data.recorded)} recorded windows, {len(data.generated or ())} generated, {len(data.validation)} held"
        )
        options = Options(steps=steps, seed=seed, recorded_share=recorded_share)
        about = {
            "command": f"forefield train predictor --tracks {' '.join(f.name for f in files)} --networks {networks} "
            f"--hidden {hidden} --steps {steps} --seed {seed} --stride {stride} --recorded-share {recorded_share} "
            f"--shrink {shrink[0]} {shrink[1]}{''.join(f' --hold-out {s}' for s in hold_out or ())}"
            f"{' --note ' + shlex.quote(note) if note else ''} --out DIR",
            "note": note,
            "tables": training.digests(files),
        }

        order = [plan.name for plan in wanted]

        def told(name: str, step: int, total: int, loss: float, held: float, to_go: float) -> None:
            which = f"{name} ({order.index(name) + 1} of {len(order)})"
            say(f"{which}: step {step} of {total}, loss {loss:.3f}, held out {held:.3f}, {to_go:.0f} s to go")

        card = training.train(data, wanted, out, options, shrink=shrink, device=device, about=about, progress=told)
        for name, entry in card["networks"].items():
            last = entry["held_out"].get("60")
            say(
                f"{name}: held-out ratio to constant velocity at 6 s {last['ade_ratio']}/{last['fde_ratio']}"
                if last
                else name
            )


def eval_prediction(
    tracks: Tracks = None,
    scenarios: Annotated[
        list[str] | None,
        typer.Option("--scenarios", help="CommonRoad files or names.", metavar="FILES …", show_default=False),
    ] = None,
    more: Files = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Folder of weights; default: shipped.")] = None,
    policy: Annotated[Method | None, typer.Option("--policy", help="What `policy_default` is.")] = None,
    json_: Json = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the result.", metavar="OUT.png")] = None,
    markdown: Annotated[
        Path | None, typer.Option("--markdown", help="Write the tables as Markdown.", metavar="OUT.md")
    ] = None,
    stride: Stride = 5,
    group: Annotated[Group, typer.Option("--group", help="Group that table and picture show.")] = "vehicle_moving",
    repeats: Annotated[int, typer.Option("--repeats", help="Bootstrap repeats.", min=10)] = 1000,
    config_: Config = None,
    set_: Sets = None,
) -> None:
    """Measure every method of prediction on the same windows of recorded traffic."""
    with _exits():
        from evaluation import eval_prediction as measuring
        from evaluation import prediction_report as report
        from evaluation.prediction_methods import Models

        tree = configuration.load(config_, set_ or [])
        if policy is not None:
            tree = configuration.with_keys(tree, "predictor", policy=policy)
        for option, path in (("--json", json_), ("--plot", plot), ("--markdown", markdown)):
            writable(option, path)
        if bool(tracks) == bool(scenarios):
            raise ConfigError("give either --tracks FILES … or --scenarios FILES …")
        files = _files("--tracks", tracks, more) if tracks else []
        models = Models.of(weights)
        risk = config.section(tree, "risk", RiskParameters)
        settings = config.section(tree, "predictor", PredictorSettings)
        with working() as tell:
            if tracks:
                cases = measuring.track_cases(files, risk, stride, tell)
            else:
                names = [*(scenarios or []), *(more or [])]
                cases = measuring.scenario_cases(names, risk, config.section(tree, "rig", RigSettings), stride, tell)
            result = measuring.evaluate(cases, models, settings, repeats=repeats, progress=tell)
        if json_ is not None:
            write(json_, result)
        if plot is not None:
            report.plot(result, plot, group)
        if markdown is not None:
            markdown.write_text(report.markdown(result, group), encoding="utf-8")
        console = Console()
        console = Console(width=max(console.width, WIDTH))
        for site in result["sites"] if len(result["sites"]) > 1 else []:
            console.print(report.table(result, group, site))
        console.print(report.table(result, group))
        if any(result["spread"].values()):
            console.print(report.spread_table(result))


def eval_ablation(
    train_on: Annotated[list[str], typer.Option("--train-on", help="A table to train on; may be repeated.")],
    tracks: Tracks = None,
    more: Files = None,
    seeds: Annotated[int, typer.Option("--seeds", min=2, max=50)] = 5,
    steps: Steps = 600,
    hidden: Hidden = 32,
    form: Annotated[Literal["paper", "residual", "both"], typer.Option("--form", help="Of the network.")] = "both",
    stride: Stride = 5,
    work: Annotated[Path | None, typer.Option("--work", help="Folder of checkpoints, to resume.")] = None,
    json_: Json = None,
    device: TorchDevice = "cpu",
) -> None:
    """Train with and without surrounding risk, attention and leader, and compare on other sites (`--tracks`)."""
    with _exits():
        from evaluation import eval_ablation as ablating
        from evaluation import train_predictor as training
        from evaluation.training import Options
        from evaluation.trajectory_windows import recordings, windows

        _device(device)
        writable("--json", json_)
        risk = RiskParameters()
        files = _files("--tracks", tracks, more)
        with working() as tell:
            data = training.read(_files("--train-on", train_on, None), [], risk, stride, tell)
            found = [r for f in files for r in recordings(f)]
            test = windows(found, risk, stride=stride, progress=partial(tell, "windows to compare on"))
        if work is not None:
            work.mkdir(parents=True, exist_ok=True)
        result = ablating.ablation(
            data, test, ablating.arms(form, hidden), Options(steps=steps), range(seeds),
            checkpoints=work, device=device, progress=say,
        )  # fmt: skip
        if json_ is not None:
            write(json_, result)
        for part in ablating.tables(result):
            Console(width=max(Console().width, WIDTH)).print(part)


def generate_traffic(
    out: Annotated[Path, typer.Option("--out", help="Table to write (.csv.gz).")],
    seconds: Annotated[float, typer.Option("--seconds", help="Recorded on each network.", min=1.0)] = 60.0,
    repeats: Annotated[int, typer.Option("--repeats", help="Runs on each network, with other drivers.", min=1)] = 3,
    seed: Seed = 20,
) -> None:
    """Generate interactive traffic with Eclipse SUMO, written as a trajectory table."""
    with _exits():
        from evaluation import generate_traffic as generating
        from evaluation.sumo_networks import TrafficError

        if not out.name.endswith(".csv.gz"):
            raise ConfigError(f"--out {out}: the name of the table ends in .csv.gz")
        writable("--out", out)
        try:
            done = generating.generate(out, seed=seed, seconds=seconds, repeats=repeats, progress=say)
        except TrafficError as e:
            raise ConfigError(str(e)) from None
        say(f"{done.path}: {done.runs} runs, {done.tracks} tracks, {done.rows} rows, {done.teleports} teleports cut")


def bench_predictor(
    json_: Json = None,
    weights: Annotated[Path | None, typer.Option("--weights", help="Folder of weights; default: shipped.")] = None,
    network: Annotated[str, typer.Option("--network", help="Its name in the folder's card.")] = "lstm",
    rounds: Annotated[int, typer.Option("--rounds", min=5)] = 60,
) -> None:
    """Measure surrounding risk and inference against the eager autoregressive form and the matrix products."""
    with _exits():
        from evaluation import bench_predictor as measuring

        writable("--json", json_)
        result = measuring.measure(weights, name=network, rounds=rounds)
        if json_ is not None:
            write(json_, result)
        for key in ("ms_32", "ms_128", "ratio_vs_eager", "ratio_vs_gemm_floor", "ratio_128_to_32"):
            say(f"{key:20s} {result[key]:.2f}")


@contextmanager
def _exits() -> Iterator[None]:
    """As every command; refused weights and data that give nothing to do are bad input too."""
    from services.predictor.weight_files import WeightsError

    with exits():
        try:
            yield
        except (WeightsError, ValueError) as e:
            if isinstance(e, ConfigError) or type(e).__name__ == "ScenarioError":
                raise
            raise ConfigError(str(e)) from None
        except ModuleNotFoundError as e:
            raise ConfigError(f"{e}; pip install 'forefield[train]'") from None


def _files(option: str, first: list[str] | None, more: list[str] | None) -> list[Path]:
    files = [Path(f) for f in (*(first or ()), *(more or ()))]
    if not files:
        raise ConfigError(f"{option} FILES …: no file given")
    for f in files:
        if not f.is_file() or not os.access(f, os.R_OK):
            raise ConfigError(f"{f}: no such file")
    return files


def _device(device: str) -> None:
    import torch

    if device not in ("cpu", "cuda"):
        raise ConfigError(f"--device {device}: cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda: PyTorch sees no CUDA device")
