"""Road networks for generated traffic: given SUMO networks and ones that netgenerate and netconvert make.

Every network is a `.net.xml` file of Eclipse SUMO. The shapes cover what recorded places have: signalised and
unsignalised crossings with turns, roundabout-like webs, bending streets, a motorway with a ramp and a narrowing.
"""

from __future__ import annotations

import math
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOTORWAYS = ((33.0, 1.0), (27.0, 0.8), (22.0, 0.6), (20.0, 0.35), (16.0, 0.7))
"""Speed limit [m/s] of each motorway, and the share of it that is left where it gets narrow."""


class TrafficError(RuntimeError):
    """Traffic cannot be generated: why, and what to do."""


@dataclass(frozen=True)
class Network:
    """One network and how busy it is."""

    name: str
    path: Path
    per_hour: float
    """Vehicles that enter at each road into the network [1/h]."""
    fast: bool
    """A motorway: no crossing traffic, keep to higher speeds."""


def networks(folder: Path, given: list[Path], seed: int) -> list[Network]:
    """Make the networks in `folder`; `given` networks come first.

    Raises:
        TrafficError: SUMO is not installed or refuses.
    """
    rng = np.random.default_rng([seed, 101])
    made = [Network(p.name.split(".")[0], p, 900.0 if "101" in p.name else 250.0, "101" in p.name) for p in given]
    speed = f"{rng.uniform(11.0, 14.5):.2f}"
    grids = (
        ("signals", "4", "130", "2", "traffic_light", "420"),
        ("priority", "4", "110", "1", "priority", "260"),
        ("arterial", "3", "220", "3", "traffic_light", "900"),
    )
    for name, number, length, lanes, junction, per_hour in grids:
        out = folder / f"{name}.net.xml"
        _call(
            "netgenerate", "--grid", "--grid.number", number, "--grid.length", length, "--grid.attach-length", length,
            "--default.lanenumber", lanes, "--default.speed", speed, "--default-junction-type", junction,
            "--turn-lanes", "1" if junction == "traffic_light" else "0", "--turn-lanes.length", "40",
            "--junctions.limit-turn-speed", "4.5", "--junctions.corner-detail", "12", "--no-turnarounds", "true",
            "--default.junctions.radius", "7", "--perturb-x", "norm(0,7)", "--perturb-y", "norm(0,7)",
            "--seed", str(seed), "-o", str(out),
        )  # fmt: skip
        made.append(Network(name, out, float(per_hour), False))
    made.append(Network("bends", _bends(folder, rng), 500.0, False))
    for k, (limit, jam) in enumerate(MOTORWAYS):
        path = _motorway(folder, k, 3 + k % 2, limit, jam)
        made.append(Network(f"motorway{k}", path, 4 * rng.uniform(1300.0, 1900.0), True))
    return made


def _bends(folder: Path, rng: np.random.Generator) -> Path:
    """Two streets that wind and cross."""
    nodes, edges = [], []
    for s, (angle, lanes) in enumerate(((0.1, 2), (1.5, 1))):
        along = np.linspace(-420.0, 420.0, 85)
        wave = 26.0 * np.sin(along / rng.uniform(38.0, 55.0) + s) * np.clip(np.abs(along) / 60.0 - 0.4, 0.0, 1.0)
        c, n = math.cos(angle), math.sin(angle)
        points = np.column_stack((along * c - wave * n, along * n + wave * c))
        for k, end in enumerate((0, -1)):
            x, y = points[end]
            nodes.append(f'<node id="s{s}e{k}" x="{x:.2f}" y="{y:.2f}"/>')
        for k, part in enumerate((points[:43], points[42:][::-1])):
            shape = " ".join(f"{x:.2f},{y:.2f}" for x, y in part)
            back = " ".join(f"{x:.2f},{y:.2f}" for x, y in part[::-1])
            common = f'numLanes="{lanes}" speed="12.5"'
            edges.append(f'<edge id="s{s}e{k}in" from="s{s}e{k}" to="c" {common} shape="{shape}"/>')
            edges.append(f'<edge id="s{s}e{k}out" from="c" to="s{s}e{k}" {common} shape="{back}"/>')
    nodes.append('<node id="c" x="0" y="0" type="traffic_light" radius="8"/>')
    return _convert(folder, "bends", nodes, edges)


def _motorway(folder: Path, k: int, lanes: int, limit: float, jam: float) -> Path:
    """1.4 km that bends a little: an entrance, a lane that ends, a slower part."""
    side = -1.0 if k % 2 else 1.0
    nodes = [
        f'<node id="{name}" x="{x}" y="{side * y}"/>'
        for name, x, y in (
            ("a", 0, 0),
            ("b", 450, 8),
            ("c", 750, 30),
            ("d", 1050, 75),
            ("e", 1450, 170),
            ("r", 200, 70),
        )
    ]
    edges = [
        f'<edge id="ab" from="a" to="b" numLanes="{lanes}" speed="{limit}"/>',
        f'<edge id="bc" from="b" to="c" numLanes="{lanes + 1}" speed="{limit}"/>',
        f'<edge id="cd" from="c" to="d" numLanes="{lanes}" speed="{(1.0 + jam) / 2.0 * limit:.2f}"/>',
        f'<edge id="de" from="d" to="e" numLanes="{lanes}" speed="{jam * limit:.2f}"/>',
        f'<edge id="rb" from="r" to="b" numLanes="1" speed="{0.8 * limit:.2f}"/>',
    ]
    return _convert(folder, f"motorway{k}", nodes, edges)


def _convert(folder: Path, name: str, nodes: list[str], edges: list[str]) -> Path:
    node_file, edge_file, out = (folder / f"{name}.{end}" for end in ("nod.xml", "edg.xml", "net.xml"))
    node_file.write_text(f"<nodes>{''.join(nodes)}</nodes>\n")
    edge_file.write_text(f"<edges>{''.join(edges)}</edges>\n")
    _call(
        "netconvert", "-n", str(node_file), "-e", str(edge_file), "--no-turnarounds", "true",
        "--junctions.limit-turn-speed", "4.5", "--junctions.corner-detail", "12", "-o", str(out),
    )  # fmt: skip
    return out


def _call(program: str, *arguments: str) -> None:
    try:
        import sumo
    except ImportError:
        raise TrafficError("generated traffic needs Eclipse SUMO: pip install 'forefield[traffic]'") from None
    path = Path(sumo.SUMO_HOME) / "bin" / program
    done = subprocess.run([str(path), *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = "; ".join(done.stderr.strip().splitlines()[:3]) or "failed"
        raise TrafficError(f"{program}: {said}")
