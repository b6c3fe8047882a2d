"""All orders in a plane-parallel layer, exactly: the truth where a planet is so large that it is flat."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class Slab:
    """All orders of scattering in homogeneous plane-parallel layers over a Lambertian ground, by adding and doubling.

    Van de Hulst (1963); Hansen and Travis (1974), "Light scattering in planetary atmospheres", section 3. The result
    is exact to the number of directions: ``mu`` are the cosines at which radiance is wanted and at which the sun may
    stand; they join the Gauss nodes with weight zero. ``moments`` are Legendre moments of the phase function, chi_0
    = 1; ``single_scattering_albedo`` is one number.
    """

    def __init__(self, moments: ArrayLike, single_scattering_albedo: float, mu: ArrayLike, nodes: int = 24):
        x, w = legendre.leggauss(nodes)
        self.wanted = np.atleast_1d(np.asarray(mu, float))
        self.mu = np.r_[(x + 1) / 2, self.wanted]
        self.weight = np.r_[(x + 1) / 2 * w, np.zeros(self.wanted.size)]  # 2 mu dmu
        self.chi = np.atleast_1d(np.asarray(moments, float))
        self.albedo = single_scattering_albedo

    def _phase_modes(self, m: int) -> tuple[Array, Array]:
        """Fourier mode m of the phase function (mean 1 over the sphere): (reflected, transmitted), [mu, mu_0]."""
        size, mu = self.chi.size, self.mu
        ylm = np.zeros((size, mu.size))  # sqrt((l-m)!/(l+m)!) P_lm, by recurrence in l
        previous, current = np.zeros_like(mu), np.ones_like(mu)
        for k in range(1, m + 1):
            current = current * np.sqrt((2 * k - 1) / (2 * k)) * np.sqrt(1 - mu * mu)
        for degree in range(m, size):
            ylm[degree] = current
            ahead = (2 * degree + 1) * mu * current - np.sqrt(degree**2 - m**2) * previous
            previous, current = current, ahead / np.sqrt((degree + 1) ** 2 - m**2)
        order = np.arange(size)
        weights = (2 * order + 1) * self.chi
        sign = (-1.0) ** (order + m)
        return (ylm.T * (weights * sign)) @ ylm, (ylm.T * weights) @ ylm

    def _product(self, a: Array, b: Array) -> Array:
        return (a * self.weight) @ b

    def _add(self, above: tuple, below: tuple) -> tuple[Array, Array, Array, Array]:
        """Put one layer over another: (R, T of both; D, U between them). A layer is (R, T, exp(-tau/mu))."""
        (ra, ta, ea), (rb, tb, eb) = above, below
        echo = self._product(ra, rb)  # layers are homogeneous: reflection is the same from below
        total = np.linalg.solve(np.eye(self.mu.size) - echo * self.weight, echo)
        down = ta + self._product(total, ta) + total * ea
        up = self._product(rb, down) + rb * ea
        reflected = ra + ea[:, None] * up + self._product(ta, up)
        transmitted = eb[:, None] * down + tb * ea + self._product(tb, down)
        return reflected, transmitted, down, up

    def _layer(self, tau: float, m: int) -> tuple[Array, Array, Array]:
        """(R, T, exp(-tau/mu)) of a layer of optical depth ``tau``, doubled up from one so thin that it scatters
        once.
        """
        doublings = max(0, int(np.ceil(np.log2(tau / 1e-7))))
        thin, inverse = tau / 2**doublings, 1 / self.mu
        back, forward = self._phase_modes(m)
        once = self.albedo * thin / 4 * np.outer(inverse, inverse)
        reflected, transmitted = once * back, once * forward
        for _ in range(doublings):
            layer = reflected, transmitted, np.exp(-thin * inverse)
            reflected, transmitted = self._add(layer, layer)[:2]
            thin *= 2
        return reflected, transmitted, np.exp(-tau * inverse)

    def radiance(
        self, tau_above: float, tau_below: float, ground: float, mu_0: float, azimuth: ArrayLike
    ) -> tuple[Array, Array]:
        """Diffuse radiance for sunlight of normal irradiance 1 between two parts of the layer: (down, up), each [mu,
        azimuth].

        ``tau_above`` or ``tau_below`` may be 0; ``ground`` is the Lambertian albedo; ``mu_0`` must be one of the
        wanted ``mu``; ``azimuth`` (rad) is the view's minus the sun's, as in the contract. "Up" includes the
        ground's own radiance.
        """
        azimuth = np.atleast_1d(np.asarray(azimuth, float))
        sun = self.mu.size - self.wanted.size + int(np.flatnonzero(np.isclose(self.wanted, mu_0))[0])
        zero = np.zeros((self.mu.size,) * 2)
        down, up = (np.zeros((self.wanted.size, azimuth.size)) for _ in range(2))
        for m in range(self.chi.size):
            nothing = zero, zero, np.ones_like(self.mu)
            surface = (np.full_like(zero, ground if m == 0 else 0.0), zero, np.zeros_like(self.mu))
            lower = self._layer(tau_below, m) if tau_below > 0 else nothing
            upper = self._layer(tau_above, m) if tau_above > 0 else nothing
            floor = (self._add(lower, surface)[0], zero, np.zeros_like(self.mu))
            _, _, d, u = self._add(upper, floor)
            wave = (1 if m == 0 else 2) * np.cos(m * azimuth) * mu_0 / np.pi
            down += d[-self.wanted.size :, sun, None] * wave
            up += u[-self.wanted.size :, sun, None] * wave
        return down, up
