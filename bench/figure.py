"""The picture of run time against error, one panel per group of rays (needs Matplotlib)."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .truth import GROUPS

COLOURS = {
    "atmo-jit": "#c0392b",
    "atmo-jit resolution": "#e59866",
    "bruneton2017": "#2471a3",
    "hillaire2020": "#229954",
    "sasktran2": "#7d3c98",
    "path tracer": "#707b7c",
}
TITLES = {
    "day": "by day, away from the horizon",
    "horizon": "towards the horizon",
    "twilight": "sun at or below the horizontal",
    "limb": "past the limb, from space",
    "haze": "haze, by day",
    "haze horizon": "haze, towards the horizon",
}


def draw(result: Mapping[str, Any], path: Path) -> None:
    """Write the PNG ``path``: p95 of the error over CPU seconds of the solve, both logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.0), layout="constrained")
    few = {
        row["method"]: f" ({len(row['cases'])} atmospheres)"
        for row in result.get("frontier", ())
        if row["cases"] != "all"
    }
    panels = figure.subplots(2, 3, sharex=True, sharey=True).ravel()
    for panel, group in zip(panels, GROUPS, strict=True):
        for method, points in _points(result, group).items():
            seconds, errors, settings = zip(*sorted(points), strict=True)
            own = method == "atmo-jit"
            panel.plot(
                seconds,
                errors,
                marker="o",
                markersize=5 if own else 3.5,
                linewidth=2 if own else 1,
                color=COLOURS.get(method),
                label=method + few.get(method, ""),
            )
            for x, y, text in zip(seconds, errors, settings, strict=True):
                panel.annotate(_number(text), (x, y), xytext=(3, 3), textcoords="offset points", fontsize=6)
        panel.set_title(TITLES[group], fontsize=9)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.grid(True, which="both", linewidth=0.3, alpha=0.5)
        panel.tick_params(labelsize=8)
    handles: dict[str, Any] = {}
    for panel in panels:
        handles |= {label: line for line, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles) or 1, fontsize=8)
    panels[4].set_xlabel("CPU seconds: solve (peers without one: all rays of an atmosphere)", fontsize=9)
    figure.supylabel("error of radiance, 95th percentile, per cent", fontsize=9)
    figure.suptitle(f"Run time against error; truth: {result['truth']}", fontsize=10)
    figure.savefig(path, format="png", dpi=110, metadata={"Software": None})


def _number(setting: str) -> str:
    """The numbers of a setting: "16 streams, 9 suns" -> "16, 9"."""
    return ", ".join(re.findall(r"[0-9.]*[0-9]", setting))


def _points(result: Mapping[str, Any], group: str) -> dict[str, list[tuple[float, float, str]]]:
    """(CPU seconds, p95, setting) of every row that has rays of the group, by method."""
    points: dict[str, list[tuple[float, float, str]]] = defaultdict(list)
    for row in [*result.get("frontier", ()), *result.get("peers", ())]:
        for part in row.get("groups", ()):
            if part["group"] == group and part["rays"] and part["cpu_s"] and part["p95"]:
                points[row["method"]].append((part["cpu_s"], part["p95"], row["setting"]))
    return points
