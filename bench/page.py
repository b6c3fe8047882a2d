"""Markdown of the measured tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

INTRODUCTION = """# Accuracy

Printed by `python -m bench.accuracy --out docs/accuracy.md` (atmo-jit {version}; {seconds:.0f} s). The
references were made by others' code or by brute force in double precision, none of it with this package;
`bench/reference.py` says which file is what. Errors are in per cent of the reference.
"""

SUMMARY = """## In short

Errors in per cent. Single scattering: over all altitudes, the largest of the figures of the sun angles named; "high" is
the 99th percentile, and the peer is Bruneton's 2017 tables. All orders: over all rays of the kind; "high" is the 95th
percentile, like the maximum of what exceeds three standard deviations of the reference, and the peer is SASKTRAN2's
discrete ordinates with 16 streams. The sections below say against what.
"""

SINGLE = """## Single scattering

The Earth of Bruneton's 2017 paper, six altitudes from 1 m to 400 km, 64 view zenith angles, 5 azimuths,
680/550/440 nm; `orders=1, ground=False`; where radiance exceeds 1e-3 of the peak of that altitude and sun. The
last three columns are Bruneton's 2017 tables on the same rays. Below 90 degrees the reference lets the sun's
disc set smoothly over its diameter, and so does the package.
"""

IRRADIANCE = """## Irradiance

On a horizontal surface. The sky's reference is itself 0.2-1.6 % too bright: its quadrature was coarse.
"""

ORDERS = """## All orders

711 rays in 17 atmospheres against spherical backward Monte Carlo (double precision; its own noise, one sigma,
has a median of 0.08 %). The 95th percentile and the maximum are of what exceeds three sigma. "Within 1 %" is the part
of the rays whose error is below 1 % plus three sigma; "rms/sigma" is the rms error in units of the reference's noise.
"""


def table(rows: Iterable[Mapping], columns: Mapping[str, str]) -> str:
    """A Markdown table of ``rows``; ``columns`` maps a row's key to its heading."""
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(cell(key, row.get(key)) for key in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def summary(result: Mapping) -> str:
    """The few rows that say how accurate the package is; README.md has the same."""
    rows = []
    single = result["single_scattering"]["radiance"], result["peers"]["bruneton2017, order 1"]
    for low, high in ((0, 80), (88, 90), (94, 100)):
        figures = []
        for part in single:
            inside = [r for r in part if r["altitude_m"] == "all" and low <= r["sun_zenith_deg"] <= high]
            figures += [max(row[key] for row in inside) for key in ("median", "p99", "max")]
        rows.append((f"single scattering, sun at {low}-{high} deg", figures))
    orders = result["sky_radiance"], result["peers"]["sasktran2, do16"]
    kinds = {"plain": "all orders, by day", "any flag": "all orders: twilight, horizon, limb, close to the sun"}
    for group, name in kinds.items():
        (own,), (other,) = ([r for r in part if r["case"] == "all" and r["group"] == group] for part in orders)
        rows.append((name, [row[key] for row in (own, other) for key in ("median", "p95", "max")]))
    columns = ("median", "high", "max", "peer: median", "peer: high", "peer: max")
    named = [{"light": name, **dict(zip(columns, figures, strict=True))} for name, figures in rows]
    return table(named, {"light": "light", **{column: column for column in columns}})


def cell(key: str, value: object) -> str:
    """One number as text: fractions in per cent, distances and angles whole, errors to two or three digits."""
    if value is None or value != value:
        return "-"
    if not isinstance(value, float):
        return str(value)
    if key.startswith("within"):
        return f"{100 * value:.1f}"
    if key.endswith("_abs"):
        return f"{value:.1e}"
    if key.endswith(("_m", "_height", "_deg", "_nm", "flag")):
        return f"{value:g}" if value == round(value) else f"{value:.1f}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def accuracy_page(result: Mapping) -> str:
    """The page docs/accuracy.md from what ``bench.accuracy.measure`` returns."""
    from atmo_jit import __version__

    error = {"rays": "rays", "median": "median %", "p99": "p99 %", "max": "max %"}
    orders = {"rays": "rays", "median": "median %", "p95": "p95 beyond 3 sigma %", "max": "max beyond 3 sigma %"}
    orders |= {"within_1": "within 1 %", "within_3": "within 3 %", "rms_sigma": "rms/sigma"}
    single = result["single_scattering"]
    peer = result["peers"]["bruneton2017, order 1"]
    both = [
        {**own, "peer_median": other["median"], "peer_p99": other["p99"], "peer_max": other["max"]}
        for own, other in zip(single["radiance"], peer, strict=True)
    ]
    beside = {"peer_median": "2017: median %", "peer_p99": "2017: p99 %", "peer_max": "2017: max %"}
    rows = result["sky_radiance"]
    others = {name: part for name, part in result["peers"].items() if name.startswith("sasktran2")}
    compared = [{"solver": "atmo-jit", **row} for row in rows if row["case"] == "all"]
    compared += [{"solver": name, **row} for name, part in others.items() for row in part if row["case"] == "all"]
    ray = {"case": "case", "obs_height": "altitude m", "sun_zenith_deg": "sun", "view_zenith_deg": "view"}
    ray |= {"rel_azimuth_deg": "azimuth", "wavelength_nm": "nm", "flag": "flag", "error": "error %", "sigma": "sigma %"}
    transmittance = single["transmittance"]
    parts = [
        INTRODUCTION.format(version=__version__, seconds=result["seconds"]),
        SUMMARY,
        summary(result),
        SINGLE,
        table(both, {"sun_zenith_deg": "sun deg", "altitude_m": "altitude m", **error, **beside}),
        f"Transmittance of {transmittance['rays']} rays to the top: at most {transmittance['max_abs']:.1e} off.\n",
        "## Aerial perspective\n\nSegments of 100 m to 200 km from four altitudes, single scattering, by sun zenith.\n",
        table(
            result["aerial_perspective"],
            {"sun_zenith_deg": "sun deg", **error, "transmittance_max_abs": "transmittance, max abs"},
        ),
        IRRADIANCE,
        table(result["irradiance"], {"irradiance": "irradiance", "altitude_m": "altitude m", **error}),
        ORDERS,
        table(compared, {"solver": "solver", "group": "rays with", **orders}),
        "By atmosphere:\n",
        table([row for row in rows if row["case"] != "all"], {"case": "case", "group": "rays with", **orders}),
        "The ten rays farthest beyond the reference's noise:\n",
        table(result["worst_rays"], ray),
    ]
    return "\n".join(parts)
