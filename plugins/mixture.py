"""The phase function of ``atmosphere_medium``: that of its constituents, mixed per wavelength by what each scatters
at that point.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from atmo_jit.atmosphere import Constituent
from atmo_jit.phase import CornetteShanks, HenyeyGreenstein, Isotropic, RayleighPhase

from .air import Air
from .cornette_shanks import density, direction, henyey_greenstein_cosine, rayleigh_cosine

# Directions of tabulated and Legendre phase functions are drawn from samples of them at this many cosines, and no less
# than this share of their mean, so that weights stay bounded where a truncated series dips below 0.
PROPOSAL_NODES = 513
PROPOSAL_FLOOR = 0.01


class AirPhase:
    """sum_c s_c p_c(nu) / sum_c s_c with s_c the scattering coefficient of constituent c, per wavelength.

    (A ``blendphase`` has one weight for all wavelengths, which is wrong by tens of percent.) Set ``air`` before use.
    Directions are drawn from a mixture that is the same for all channels: constituent c with its share of the
    scattering, averaged over the channels."""

    def __init__(self, props: Any) -> None:
        mi.PhaseFunction.__init__(self, props)
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic
        self.air: Air | None = None

    def use(self, air: Air) -> None:
        """Set the air, before anything else."""
        self.air = air
        self._scatterers = [(i, c) for i, c in enumerate(air.atmosphere.constituents) if c.phase is not None]
        self._tables = {c.name: proposal(c) for _, c in self._scatterers}

    def sample(self, ctx: Any, mei: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any, Any]:
        parts = self._parts(mei)
        total = parts_total(parts)
        below, rest, nu = 0.0, sample1, mi.Float(0.0)
        proposals = self._proposals(parts, total)
        for share, c, g in proposals:
            # The last one takes what rounding left over.
            nu = dr.select(rest >= below, self._cosine(c, g, sample2[0]), nu)
            below = below + share
        value, pdf = self._evaluate(parts, total, proposals, nu)
        weight = value / dr.select(pdf > 0.0, pdf, 1.0)
        return direction(mei, nu, sample2[1]), _scalar(weight), pdf

    def eval_pdf(self, ctx: Any, mei: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        parts = self._parts(mei)
        total = parts_total(parts)
        value, pdf = self._evaluate(parts, total, self._proposals(parts, total), -dr.dot(wo, mei.wi))
        return _scalar(value), pdf

    def _parts(self, mei: Any) -> list[tuple[Constituent, Any, Any]]:
        """Of every scatterer: scattering coefficient at the point (1/m) and g, unpolarised spectra."""
        value = self.air.pick(mei)
        densities = self.air.densities(self.air.altitude(mei.p))
        return [
            (c, self.air.scattering(c, value) * densities[i], self.air.asymmetry(c, value)) for i, c in self._scatterers
        ]

    def _proposals(self, parts: list[tuple[Constituent, Any, Any]], total: Any) -> list[tuple[Any, Constituent, Any]]:
        """Probability, constituent and g (a number) of every distribution of the mixture that directions are drawn
        from.
        """
        result = []
        # Where nothing scatters the shares are 0; in scalar variants a division by zero is an exception.
        inverse = dr.detach(1.0 / dr.select(total > 0.0, total, 1.0))
        for c, scattering, g in parts:
            share = dr.detach(scattering) * inverse
            if g is None:
                result.append((dr.mean(share), c, None))
            elif self.air.wavelengths.uniform(f"{c.name}.phase.g", self.air.values):
                result.append((dr.mean(share), c, dr.detach(g[0])))
            else:
                result.extend((share[i] / len(g), c, dr.detach(g[i])) for i in range(len(g)))
        return result

    def _evaluate(self, parts: Any, total: Any, proposals: Any, nu: Any) -> tuple[Any, Any]:
        """Value of the phase function (a spectrum) and density of the directions drawn, at a cosine."""
        mixed = mi.UnpolarizedSpectrum(0.0)
        for c, scattering, g in parts:
            mixed += scattering * self.air.phase_value(c, g, nu)
        pdf = mi.Float(0.0)
        for share, c, g in proposals:
            pdf += share * self._density(c, g, nu)
        return mixed / dr.select(total > 0.0, total, 1.0), pdf

    def _density(self, c: Constituent, g: Any, nu: Any) -> Any:
        if g is not None:
            return density(HenyeyGreenstein, g, nu)
        table = self._tables[c.name]
        return mi.Float(c.phase.value(nu)) if table is None else table.eval_pdf_normalized(nu) * dr.inv_two_pi

    def _cosine(self, c: Constituent, g: Any, sample: Any) -> Any:
        if g is not None:
            return henyey_greenstein_cosine(g, sample)
        if isinstance(c.phase, RayleighPhase):
            return rayleigh_cosine(sample)
        table = self._tables[c.name]
        return 2.0 * sample - 1.0 if table is None else dr.clip(table.sample(sample), -1.0, 1.0)

    def to_string(self) -> str:
        return f"AirPhase[{', '.join(f'{c.name}: {c.phase}' for _, c in self._scatterers)}]"


def _scalar(value: Any) -> Any:
    """The spectrum of an intensity without polarization, in polarized variants as a matrix of Mueller (made of the
    array of four wavelengths itself, `mi.Spectrum` takes them for the matrix's four rows).
    """
    return mi.depolarizer(mi.UnpolarizedSpectrum(value))


def parts_total(parts: list[tuple[Constituent, Any, Any]]) -> Any:
    """Scattering coefficient of all constituents together."""
    return sum((scattering for _, scattering, _ in parts), mi.UnpolarizedSpectrum(0.0))


def proposal(c: Constituent) -> Any:
    """The distribution of cosines to draw from where there is no closed form, None where there is."""
    if isinstance(c.phase, (RayleighPhase, Isotropic, CornetteShanks, HenyeyGreenstein)):
        return None
    nodes = np.linspace(-1.0, 1.0, PROPOSAL_NODES)
    values = np.maximum(np.asarray(c.phase.value(nodes)), PROPOSAL_FLOOR * 0.25 / np.pi)
    return mi.IrregularContinuousDistribution(nodes.tolist(), values.tolist())
