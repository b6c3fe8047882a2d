"""Tables that stand in for the march: constant time per look-up, filled from a solved :class:`atmo_jit.solved.Sky`.

>>> from atmo_jit.bake.sky_view import SkyView
>>> from atmo_jit.solved import Sky
>>> view = SkyView(Sky("earth"), altitude_m=2.0, sun_zenith=0.9)
>>> red, green, blue = view.radiance([0.0, 1.5], [0.0, 3.0])

Modules: :mod:`.sky_view` (one observer, one sun), :mod:`.froxels` (aerial perspective), :mod:`.tables` (all observers,
suns and views), :mod:`.client` (Bruneton's layout), :mod:`.method` (which of them a list of views is worth),
:mod:`.error` (how far they are from the solution).
"""
