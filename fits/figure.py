"""The picture of a fit: data, fit and residual (needs Matplotlib)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .fit import Fit
from .result import scattering_angle

LARGEST = 20_000  # points in a panel
SHOWN = 5  # wavelengths in a panel


def draw(fit: Fit, result: dict[str, Any], path: str | Path) -> None:
    """Write a PNG: the sky as measured, as fitted, and their ratio, at the middle wavelength; radiance over scattering
    angle, residual over scattering angle and over wavelength."""
    from matplotlib.figure import Figure

    data, predicted = fit.problem.data, fit.found.predicted
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.where(data.used & (data.radiance > 0.0), 100.0 * (predicted / data.radiance - 1.0), np.nan)
    names = (
        [f"{nm:g} nm" for nm in data.wavelengths_nm]
        if data.mixing is None
        else [f"channel {c}" for c in range(len(data.mixing))]
    )
    counts = data.used.sum(axis=0)
    usable = np.flatnonzero(counts)
    middle = int(usable[len(usable) // 2])
    figure = Figure(figsize=(12.0, 7.5), layout="constrained")
    rows = figure.subplots(2, 3)
    measured = np.where(data.used, data.radiance, np.nan)
    high = float(np.nanpercentile(measured[:, middle], 98))
    largest = max(1.0, float(np.nanpercentile(np.abs(residual[:, middle]), 98)))
    for panel, values, title, limits, colours in (
        (rows[0, 0], measured[:, middle], f"measured, {names[middle]}", (0.0, high), "viridis"),
        (rows[0, 1], predicted[:, middle], "fitted", (0.0, high), "viridis"),
        (rows[0, 2], residual[:, middle], "fitted / measured - 1, %", (-largest, largest), "RdBu_r"),
    ):
        _sky(figure, panel, data, values, title, limits, colours)
    angle = np.degrees(scattering_angle(fit))
    thin = slice(None, None, max(1, len(angle) // LARGEST))
    shown = usable[np.unique(np.linspace(0, len(usable) - 1, SHOWN).round().astype(int))]
    for i, c in enumerate(shown):
        colour = f"C{i}"
        rows[1, 0].plot(angle[thin], measured[thin, c], ".", markersize=2, color=colour, label=names[c])
        order = np.argsort(angle)
        rows[1, 1].plot(angle[order][thin], residual[order, c][thin], ".", markersize=2, color=colour)
    rows[1, 0].set(xlabel="scattering angle, deg", ylabel="measured radiance", yscale="log")
    rows[1, 0].legend(fontsize=7)
    rows[1, 1].set(xlabel="scattering angle, deg", ylabel="fitted / measured - 1, %")
    rows[1, 1].axhline(0.0, color="black", linewidth=0.5)
    by = result["by_wavelength"]
    x = [row.get("wavelength_nm", row.get("channel")) for row in by]
    rows[1, 2].errorbar(
        x, [100.0 * row["bias"] for row in by], [100.0 * row["relative_rms"] for row in by], fmt="o", markersize=3
    )
    rows[1, 2].axhline(0.0, color="black", linewidth=0.5)
    rows[1, 2].set(xlabel="wavelength, nm" if data.mixing is None else "channel", ylabel="mean and rms residual, %")
    text = [f"{name} = {value:.4g}" for name, value in list(fit.values.items())[:4]]
    figure.suptitle("   ".join(text), fontsize=8)
    figure.savefig(path, dpi=110, format="png")


def _sky(
    figure: Any, panel: Any, data: Any, values: np.ndarray, title: str, limits: tuple[float, float], colours: str
) -> None:
    """Samples by view direction: zenith in the middle, the sun upward."""
    radius = np.degrees(data.view_zenith)
    size = float(np.clip(9e3 / len(values), 1.0, 60.0))
    points = panel.scatter(
        radius * np.sin(data.azimuth), radius * np.cos(data.azimuth), c=values, s=size, cmap=colours,
        vmin=limits[0], vmax=limits[1], linewidths=0,
    )  # fmt: skip
    sun = np.degrees(data.sun_zenith[0])
    panel.plot([0.0], [sun], marker="o", markerfacecolor="none", markeredgecolor="orange", linestyle="none")
    panel.set(title=title, aspect="equal", xticks=[], yticks=[])
    panel.title.set_fontsize(9)
    figure.colorbar(points, ax=panel, shrink=0.8)
