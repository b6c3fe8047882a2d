"""The phase function ``cornette_shanks``, and sampling of the scattering angle."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from atmo_jit.errors import AtmosphereError, shown
from atmo_jit.phase import CornetteShanks, HenyeyGreenstein

from .exposed import array, single


class CornetteShanksPhase:
    r"""
    .. _phase-cornette_shanks:

    Cornette-Shanks phase function (:monosp:`cornette_shanks`)
    ----------------------------------------------------------

    .. pluginparameters::

     * - g
       - |float|
       - Asymmetry parameter in (-1, 1). (Default: 0.8)
       - |exposed|, |differentiable|

    Henyey and Greenstein's peak with the symmetry of Rayleigh scattering (Cornette and Shanks 1992):

    .. math::

        p(\nu) = \frac{3}{8 \pi} \frac{(1 - g^2) (1 + \nu^2)}{(2 + g^2) (1 + g^2 - 2 g \nu)^{3/2}}

    with :math:`\nu` the cosine of the scattering angle, 1 = straight on. ``g`` = 0 is Rayleigh's phase function.
    The mean cosine is :math:`3 g (4 + g^2) / (5 (2 + g^2))`, not ``g``.

    Directions are drawn from Henyey and Greenstein's peak by exact inversion, so ``pdf`` is that density and the weight
    is the ratio :math:`3 (1 + \nu^2) / (2 (2 + g^2))`, between 0.5 and 1.5. (The inverse of this function's own
    cumulative distribution is the root of a quartic that loses its digits in single precision.)

    .. tabs::
        .. code-tab:: xml
            :name: cornette-shanks

            <phase type="cornette_shanks">
                <float name="g" value="0.76"/>
            </phase>

        .. code-tab:: python

            'type': 'cornette_shanks',
            'g': 0.76
    """

    def __init__(self, props: Any) -> None:
        mi.PhaseFunction.__init__(self, props)
        g = float(props.get("g", 0.8))
        if not -1.0 < g < 1.0:
            raise AtmosphereError("g", shown(g), "a number in (-1, 1)")
        self.m_flags = mi.PhaseFunctionFlags.Anisotropic
        self._values = array(g)
        self.parameters_changed()

    def traverse(self, callback: Any) -> None:
        callback.put("g", self._values, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()) -> None:
        if dr.is_jit_v(mi.Float):
            # A literal would be compiled into the kernel, and another value need another one.
            dr.make_opaque(self._values)

    @property
    def _g(self) -> Any:
        return single(self._values)

    def sample(self, ctx: Any, mei: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any, Any]:
        nu = henyey_greenstein_cosine(self._g, sample2[0])
        weight = 1.5 * (1.0 + nu * nu) / (2.0 + self._g * self._g)
        return direction(mei, nu, sample2[1]), mi.Spectrum(weight), density(HenyeyGreenstein, self._g, nu)

    def eval_pdf(self, ctx: Any, mei: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        nu = -dr.dot(wo, mei.wi)
        return mi.Spectrum(density(CornetteShanks, self._g, nu)), density(HenyeyGreenstein, self._g, nu)

    def to_string(self) -> str:
        return f"CornetteShanks[g = {self._g}]"


def density(kind: type, g: Any, nu: Any) -> Any:
    """``kind(g).value(nu)`` (1/sr) in the variant's Float."""
    return mi.Float(kind(g).value(nu))


def henyey_greenstein_cosine(g: Any, sample: Any) -> Any:
    """Cosine of the scattering angle with Henyey and Greenstein's density; ``sample`` is uniform in [0, 1).

    The usual inverse (1 + g^2 - q^2) / (2 g) with q = (1 - g^2) / (1 + g t), t = 2 sample - 1, is 0/0 at g = 0. Put
    over a common denominator, g drops out: ``around_zero``. That form in turn cancels for strong peaks.
    """
    t = 2.0 * sample - 1.0
    inverse = 1.0 / (1.0 + g * t)
    around_zero = (t * (1.0 + g * g) + 0.5 * g * (t * t + 3.0 + g * g * (t * t - 1.0))) * inverse * inverse
    q = (1.0 - g * g) * inverse
    strong = dr.abs(g) > 0.5
    peaked = (1.0 + g * g - q * q) / dr.select(strong, 2.0 * g, 1.0)
    return dr.clip(dr.select(strong, peaked, around_zero), -1.0, 1.0)


def rayleigh_cosine(sample: Any) -> Any:
    """Cosine with the density 3/8 (1 + nu^2): the real root of nu^3 + 3 nu = 8 sample - 4 (Frisvad 2011, eq. 15)."""
    half = dr.abs(4.0 * sample - 2.0)
    root = dr.cbrt(half + dr.sqrt(half * half + 1.0))
    return dr.clip(dr.mulsign(root - 1.0 / root, sample - 0.5), -1.0, 1.0)


def direction(mei: Any, nu: Any, sample: Any) -> Any:
    """World direction at the scattering cosine ``nu`` and a uniform azimuth; ``mei.wi`` points back along the ray."""
    return mei.to_world(at_cosine(-nu, sample))


def at_cosine(nu: Any, sample: Any) -> Any:
    """Direction at the cosine ``nu`` from the z axis and a uniform azimuth."""
    sine = dr.safe_sqrt(1.0 - nu * nu)
    s, c = dr.sincos(2.0 * dr.pi * sample)
    return mi.Vector3f(sine * c, sine * s, nu)
