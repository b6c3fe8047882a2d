"""Markdown of a measured frontier, and its summary for the terminal.

``python -m bench.frontier_page BENCH.json docs/frontier.md`` writes the page of the documentation from the JSON of
``atmo-jit bench``, and its picture beside it under ``images/``. With several JSON files the parts of later ones (from
``atmo-jit bench --part``) replace those of the first.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from .page import table
from .truth import GROUPS

HEAD = """# Run time against error

Printed by `atmo-jit bench --out DIR` (atmo-jit {atmo_jit}; {seconds:.0f} s) and
`python -m bench.frontier_page DIR/bench.json docs/frontier.md`, on {cores} cores of a shared machine ({processor}).
Other programs ran on it: wall seconds say less than CPU seconds.
"""
FRONTIER = """## Every method and setting

Errors are 95th percentiles in per cent, raw, against {truth}. Seconds are those of a
solve of `{atmosphere}`, all suns, altitudes and directions at once: "warm" is the median of repeated solves in a
process, "cached" the first solve of a process beyond imports with a full kernel cache, "cold" with an empty one.

`bruneton2017` and `hillaire2020` are twins written from the papers (`bench/bruneton.py`, `bench/hillaire.py`); single
scattering, transmittance and the sun on the ground are this package's for all methods, so that errors are those of
multiple scattering. The tests compare the first, at full size, with texels of the published implementation.
"""
BEYOND = """### Beyond the noise

The same rays; 95th percentile and maximum of what exceeds three standard deviations of the reference, in per cent.
"""
FEW = """Slow methods were asked for some atmospheres only: {cases}.
On them atmo-jit at its default tolerance has:
"""
STAGES = """## Stages

Each stage is a kernel, named by its loops. The ratio is its time over what its own instructions and gathers would take
at this machine's measured limits: {march:.0f} million march steps (a square root and two exponentials) and
{gather:.0f} million gathers of four floats per second. Neighbouring lanes that read the same address bring it below 1.
"""
TABLES = """## Tables

Making tables from a solved `{atmosphere}`, and pictures of 1280 x 720 pixels from them in memory: medians with warm
kernels. "As planned" is what `atmo-jit plan` builds for one observer and one sun: only the suns that matter are solved.
How far tables are from the solution is in docs/method.md. CPU time counts threads that wait, too.
"""
PEERS = """## Peers in the same run
"""
SKIPPED = """## Not measured
"""


def page(result: Mapping[str, Any], picture: str | None = None) -> str:
    """The whole page; ``picture``: its place as seen from the page."""
    parts = [HEAD.format(**result, **result["machine"])]
    if picture:
        parts.append(f"![95th percentile of the error over CPU seconds]({picture})\n")
    parts += [section for section in (_frontier(result), _stages(result), _tables(result), _peers(result)) if section]
    if "curves" in result:
        from .curves import section

        parts.append(section(result["curves"]))
    if result["skipped"]:
        parts += [SKIPPED, "".join(f"- {entry['what']}: {entry['reason']}\n" for entry in result["skipped"])]
    return "\n".join(parts)


def frontier_rows(result: Mapping[str, Any], figure: str = "p95") -> list[dict[str, Any]]:
    """A flat row per method and setting: seconds, memory and the ``figure`` of every group."""
    rows = []
    for row in result.get("frontier", ()):
        flat = {key: row[key] for key in ("method", "setting")}
        flat["cases"] = "all" if row["cases"] == "all" else len(row["cases"])
        price = row["cost"]
        flat |= {"cpu_s": price["warm"]["cpu_s"], "wall_s": price["warm"]["wall_s"]}
        flat |= {"cached_s": price["cached"]["wall_s"], "cold_s": price["cold"]["wall_s"]}
        flat |= {"peak_mib": price["peak_mib"], "megabytes": price["solution_bytes"] / 1e6}
        rows.append(flat | {part["group"]: part[figure] for part in row["groups"]})
    return rows


def summary(result: Mapping[str, Any]) -> str:
    """What was found, as aligned text."""
    lines = [f"errors against: {result['truth'] or 'nothing'}"]
    machine = result["machine"]
    lines.append(
        f"limits: {machine['march_steps_per_s'] / 1e6:.0f} M march steps/s, "
        f"{machine['gathers_per_s'] / 1e6:.0f} M gathers/s, {machine['threads']} threads"
    )
    rows = frontier_rows(result)
    if rows:
        names = ("CPU s", *(f"{group} %" for group in GROUPS))
        lines.append(f"{'p95 of the error':36}" + "".join(f"{name:>16}" for name in names))
    for row in rows:
        values = [row["cpu_s"], *(row[group] for group in GROUPS)]
        lines.append(f"{row['method'] + ', ' + row['setting']:36}" + "".join(f"{_short(v):>16}" for v in values))
    for row in result.get("peers", ()):
        lines.append(f"{row['method']}, {row['setting']}: {row['note']}")
    if "curves" in result:
        from .curves import in_words

        lines += in_words(result["curves"])
    lines += [f"skipped: {entry['what']}: {entry['reason']}" for entry in result["skipped"]]
    return "\n".join(lines)


def _frontier(result: Mapping[str, Any]) -> str:
    if "frontier" not in result:
        return ""
    groups = {group: f"{group} p95 %" for group in GROUPS}
    costs = {
        "method": "method",
        "setting": "setting",
        "cpu_s": "warm CPU s",
        "wall_s": "warm wall s",
        "cached_s": "cached s",
        "cold_s": "cold s",
        "peak_mib": "peak MiB",
        "megabytes": "solution MB",
    }
    errors = {"method": "method", "setting": "setting", "cases": "atmospheres", **groups}
    text = [FRONTIER.format(**result), _table(frontier_rows(result), costs), _table(frontier_rows(result), errors)]
    if "own_on_few" in result:
        cases = next(row["cases"] for row in result["frontier"] if row["cases"] != "all")
        text.append(FEW.format(cases=", ".join(f"`{case}`" for case in cases)))
        text.append(_groups(result["own_on_few"]))
    beyond = [
        {"method": row["method"], "setting": row["setting"]}
        | {part["group"]: _pair(part["beyond_p95"], part["beyond_max"]) for part in row["groups"]}
        for row in result["frontier"]
    ]
    names = {"method": "method", "setting": "setting", **{group: group for group in GROUPS}}
    return "\n".join([*text, BEYOND, _table(beyond, names)])


def _groups(rows: Iterable[Mapping[str, Any]]) -> str:
    columns = {"group": "group", "rays": "rays", "median": "median %", "p95": "p95 %", "max": "max %"}
    return _table(rows, columns)


def _stages(result: Mapping[str, Any]) -> str:
    if "stages" not in result:
        return ""
    machine = result["machine"]
    text = [STAGES.format(march=machine["march_steps_per_s"] / 1e6, gather=machine["gathers_per_s"] / 1e6)]
    for name, rows in result["stages"].items():
        whole = sum(row["wall_s"] for row in rows)
        flat = [
            {
                "stage": row["stage"],
                "launches": row["launches"],
                "share": f"{100 * row['wall_s'] / whole:.1f}",
                "passes": f"{sum(row['passes'].values()) / row['wall_s'] / 1e6:.0f}" if "passes" in row else None,
                "gathers": f"{row['gathers_per_s'] / 1e6:.0f}" if "passes" in row else None,
                "ratio": f"{row['ratio']:.2f}" if "ratio" in row else None,
            }
            for row in rows
            if row["wall_s"] > 0.005 * whole
        ]
        heads = {
            "stage": f"{name}: loops",
            "launches": "launches",
            "share": "share %",
            "passes": "M passes/s",
            "gathers": "M gathers/s",
            "ratio": "ratio",
        }
        text.append(_table(flat, heads))
    return "\n".join(text)


def _tables(result: Mapping[str, Any]) -> str:
    if "tables" not in result:
        return ""
    heads = {"what": "what", "wall_ms": "wall ms", "cpu_ms": "CPU ms"}
    return "\n".join([TABLES.format(**result), _table(result["tables"], heads)])


def _peers(result: Mapping[str, Any]) -> str:
    rows = result.get("peers", ())
    if not rows:
        return ""
    text = [PEERS, _table(rows, {"method": "peer", "setting": "setting", "note": "what was found"})]
    flat = [
        {"method": row["method"], "setting": row["setting"]} | {part["group"]: part["p95"] for part in row["groups"]}
        for row in rows
        if "groups" in row
    ]
    if flat:
        text.append(_table(flat, {"method": "p95 of the error, %", "setting": "setting", **{g: g for g in GROUPS}}))
    return "\n".join(text)


def _table(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    return table([{key: _short(row.get(key)) for key in columns} for row in rows], columns)


def _pair(p95: float | None, most: float | None) -> str | None:
    return None if p95 is None else f"{_short(p95)} / {_short(most)}"


def _short(value: Any) -> str:
    """A figure as it is worth printing: three digits."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def main(arguments: list[str]) -> int:
    """Command line."""
    if len(arguments) < 2:
        print("usage: python -m bench.frontier_page BENCH.json [MORE.json ...] PAGE.md", file=sys.stderr)
        return 2
    from .figure import draw

    *sources, page_name = arguments
    result, *more = (json.loads(Path(source).read_text(encoding="utf-8")) for source in sources)
    for later in more:
        parts = ("frontier", "own_on_few", "tables", "peers", "curves")
        result |= {part: later[part] for part in parts if part in later}
        # Stages are measured against the limits of the same run.
        result |= {part: later[part] for part in ("stages", "machine") if "stages" in later}
    target = Path(page_name)
    picture = target.parent / "images" / f"{target.stem}.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw(result, picture)
    target.write_text(page(result, f"images/{picture.name}"), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
