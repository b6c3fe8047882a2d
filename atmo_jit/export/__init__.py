"""Tables that clients load unmodified, and what is needed to read them.

>>> from atmo_jit.export import export
>>> report = export("earth", "takram", "tables")

Modules: :mod:`.exporter` (all layouts), :mod:`.takram`, :mod:`.bruneton`, :mod:`.cosmoscout` (clients of Bruneton's
tables, :mod:`.family`), :mod:`.hillaire`, :mod:`.power3d`, :mod:`.native`; :mod:`.reader` (back from files),
:mod:`.lookup` (how clients read them, in NumPy) and :mod:`.shaders` (the same as GLSL and HLSL).
"""

from __future__ import annotations

from .exporter import LAYOUTS, PRECISIONS, TEXELS, Options, Report, export
from .reader import read

__all__ = ["LAYOUTS", "PRECISIONS", "TEXELS", "Options", "Report", "export", "read"]
