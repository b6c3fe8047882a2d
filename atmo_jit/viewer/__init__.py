"""A local web page that draws the sky from exported tables, in WebGL2: ``atmo-jit view``.

:mod:`.controls` (what the sliders change of an atmosphere), :mod:`.live` (the tables, block by block), :mod:`.server`
(loopback HTTP), and the page itself in ``page/``.
"""
