"""What `forefield eval prediction` shows of its result: tables on the terminal and in Markdown, and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.table import Table

from evaluation import prediction_scores as scoring
from services.predictor.weight_files import SHARE


def table(result: Mapping[str, Any], group: str = "vehicle_moving", site: str = "") -> Table:
    """ADE and FDE of every method in one group, with the ratio to constant velocity at 6 s."""
    results = result["sites"][site] if site else result["results"]
    n = next(iter(results.values()))[group]["60"]["n"]
    out = Table(title=f"{group}, {site or 'pooled'}: {n} windows")
    out.add_column("method", no_wrap=True)
    for t in ("2 s", "4 s", "6 s"):
        out.add_column(f"ADE/FDE {t} [m]", justify="right", no_wrap=True)
    out.add_column("ratio 6 s", justify="right", no_wrap=True)
    out.add_column("95 % (FDE)", justify="right", no_wrap=True)
    out.add_column("miss", justify="right")
    for method, groups in results.items() if n else ():
        score = groups[group]
        last = score["60"]
        cells = [f"{score[str(k)]['ade']:.2f}/{score[str(k)]['fde']:.2f}" for k in scoring.HORIZONS]
        ratio = f"{last['ade_ratio']:.3f}/{last['fde_ratio']:.3f}" if last["ade_ratio"] is not None else ""
        ci = last["fde_ratio_ci"]
        out.add_row(method, *cells, ratio, f"{ci[0]:.2f}-{ci[1]:.2f}" if ci else "", f"{last['miss']:.2f}")
    return out


def spread_table(result: Mapping[str, Any]) -> Table:
    """How many positions lie within the spread of the default network."""
    name = result["default_network"]
    out = Table(title=f"{name}: share of positions within its spread, {SHARE:.1%} where it was measured")
    for column in ("site", "windows", *(f"{k / 10:g} s" for k in scoring.HORIZONS)):
        out.add_column(column, no_wrap=True)
    for site, networks in result["spread"].items():
        if name in networks:
            by = [networks[name][str(k)] for k in scoring.HORIZONS]
            out.add_row(site, str(by[0]["n"]), *(f"{b['within']:.0%} in {b['spread']:.1f} m" for b in by))
    return out


def plot(result: Mapping[str, Any], path: Path, group: str = "vehicle_moving") -> None:
    """FDE over time, relative to constant velocity, by method; one panel a site and one for all."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    panels = {"pooled": result["results"], **result["sites"]}
    figure, axes = plt.subplots(1, len(panels), figsize=(3.4 * len(panels) + 1.5, 3.6), squeeze=False, sharey=True)
    for axis, (name, results) in zip(axes[0], panels.items(), strict=True):
        for method, groups in results.items():
            if groups[group]["60"]["fde_ratio"] is not None:
                ratios = [groups[group][str(k)]["fde_ratio"] for k in scoring.HORIZONS]
                axis.plot([k / 10 for k in scoring.HORIZONS], ratios, marker="o", ms=3, label=method)
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("seconds ahead")
    axes[0][0].set_ylabel("FDE / constant velocity's")
    axes[0][-1].legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(group, fontsize=10)
    figure.savefig(path, dpi=130, bbox_inches="tight")
    plt.close(figure)


def markdown(result: Mapping[str, Any], group: str = "vehicle_moving") -> str:
    """The same as Markdown: every method at all horizons with ratios to constant velocity, by site and pooled."""
    parts = []
    for site, results in (*result["sites"].items(), ("pooled", result["results"])):
        of = results["constant_velocity"][group]["60"]
        if not of["n"] or (site != "pooled" and len(result["sites"]) < 2):
            continue
        horizons = [f"{k / 10:g} s" for k in scoring.HORIZONS]
        parts.append(f"**{site}**, {group}: {of['n']} windows, {of['recordings']} recordings\n")
        head = ["method", *(f"ADE/FDE {h} [m]" for h in horizons), *(f"ratio {h}" for h in horizons)]
        parts.append(_row([*head, f"95 % at {horizons[-1]} (ADE, FDE)"]))
        parts.append("|---" * (len(head) + 1) + "|")
        for method, groups in results.items():
            by = [groups[group][str(k)] for k in scoring.HORIZONS]
            cells = [f"`{method}`", *(f"{s['ade']:.2f}/{s['fde']:.2f}" for s in by)]
            cells += [f"{s['ade_ratio']:.2f}/{s['fde_ratio']:.2f}" if s["fde_ratio"] else "" for s in by]
            intervals = [by[-1][f"{what}_ratio_ci"] for what in ("ade", "fde")]
            cells.append(", ".join(f"{low:.2f}–{high:.2f}" for low, high in intervals if intervals[0] and intervals[1]))
            parts.append(_row(cells))
        parts.append("")
    return "\n".join([*parts, *_spread_rows(result)])


def _spread_rows(result: Mapping[str, Any]) -> list[str]:
    name = result["default_network"]
    horizons = [str(k) for k in scoring.HORIZONS]
    known = {site: networks[name] for site, networks in result["spread"].items() if name in networks}
    if not known:
        return []
    rows = [f"**spread of `{name}`**: share of positions within it\n"]
    rows += [_row(["site", "windows", *(f"{k / 10:g} s" for k in scoring.HORIZONS)]), "|---" * 5 + "|"]
    for site, by in known.items():
        cells = [f"{by[k]['within']:.0%} in {by[k]['spread']:.1f} m" for k in horizons]
        rows.append(_row([site, str(by[horizons[0]]["n"]), *cells]))
    return [*rows, ""]


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
