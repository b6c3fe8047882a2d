"""Fits of atmospheres to measured skies.

    from atmo_jit.fits import FitConfig, fit, load_observations, result

    found = fit(load_observations("scan.npz"), FitConfig.load("fit.toml"))
    print(result(found)["parameters"]["mie.phase.g"])
"""

from __future__ import annotations

from .config import FitConfig
from .fit import Fit, fit
from .observations import Observations, load_observations, observations
from .result import result

__all__ = ["Fit", "FitConfig", "Observations", "fit", "load_observations", "observations", "result"]
