"""Every tolerance of the tests, with the reason for its size."""

# Closed forms in float64 against each other: roundings of numbers near 1 (2e-16 each), some tens of terms in a sum.
FLOAT64 = 1e-12

# Phase functions up to |g| = 0.9 against Gauss-Legendre quadrature, 60 nodes on each eighth of [-1, 1]: the nearest
# singularity, 0.0056 beyond the end, lets its error fall as 1.34^-120 = 6e-16; left are the roundings of a peak of 15.
PHASE_QUADRATURE = 1e-12

# The same formulas at the same single-precision cosines, up to g = 0.95: measured 2.5e-7. With the denominator written
# as 1 + g^2 - 2 g nu, which cancels, it is 4e-5.
PHASE_FLOAT32 = 1e-6

# Density profiles in single precision: the rounding 6e-8 of the altitude, times 12 scale heights, and one exponential.
PROFILE_FLOAT32 = 2e-6

# Reverse-mode derivatives in single precision against central differences in float64 for |g| = 0.7: measured 5e-6, from
# the cancellation between the terms of the derivative.
PHASE_GRADIENT = 2e-5

# Linear interpolation of the table of phase functions at g = 0.85: (1 / 256)^2 / 8 times the peak's curvature of 227 in
# sqrt(1 - nu) is 4e-4; the series of 100 moments lacks 2e-5 of the peak, 2e-4 at its foot.
PHASE_TABLE = 1e-3

# Derivatives of the sky, forward and reverse, in single precision: measured 5e-6 of the sum of the terms' sizes.
ADJOINT = 1e-4

# Derivatives of the sky by coefficients against central differences of the same solve, of the largest: measured 5e-4,
# from the rounding of two radiances (1e-6 over 0.01) and the bend of the function. The same by 15 parameters, with
# ``fine`` against differences of order 1 in double precision: measured 2.1e-4, by the zenith angles and by the altitude
# of the ozone layer.
DIFFERENCES = 1e-3

# The same by the zenith angle of the sun: measured 1.03e-3 under a sun at 92 degrees, whose terminator cuts rays where
# it moves with the sun, and the field asked once between two cuts is a rule whose error moves too. By the view's
# directions, with which cuts move in derivatives as well, 2e-4.
SUN_MOVED = 2e-3

# The same by profiles and radii, which move nodes of a solve, and its error of some 1e-3 with them: measured 0.03 by
# the ozone layer, by which the sky changes little, 4e-3 by scale heights.
NODES_MOVED = 0.05

# The light of all orders in single against double precision, of the sky overhead and at the horizon: measured 2e-6.
DOUBLE = 1e-5

# Derivatives of the sky against score-function Monte Carlo, without and with ``fine``: how many of 57 are off by more
# than 1 % plus three sigma (measured 7 and 0), and by how much, as the change of the logarithm of the radiance per
# change of the parameter's (measured by coefficients 0 both times, by g 0.009, on the hazy horizon, and 0: the
# derivative by g is near 0 between parts that are not, and the peak of g = 0.85 has more degrees than solves).
MONTE_CARLO_MISSED = (7, 0)
DERIVATIVE_BY_COEFFICIENT = (0.001, 0.001)
DERIVATIVE_BY_G = (0.012, 0.001)

# Pixels of the viewer against the solution, by view: relative error, median and 95th percentile. Those of the exported
# tables, linear between 32 suns and 8 angles from the sun; measured 3.0 and 7.5, 0.4 and 1.5, 6.2 and 28, 0.14 and 0.6,
# 0.13 and 0.9, 0 and 1.2 %.
VIEWER = {
    "noon": (0.04, 0.1),
    "sunset": (0.006, 0.02),
    "twilight": (0.08, 0.35),
    "10 km": (0.003, 0.01),
    "space": (0.003, 0.015),
    "far": (0.001, 0.02),
}
