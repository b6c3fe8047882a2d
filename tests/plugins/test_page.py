"""Every example of docs/plugins.md loads: the XML and the dict of each plugin."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "plugins.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("text", re.findall(r"```xml\n(.*?)```", PAGE, re.DOTALL))
def test_xml_loads(plugins, text):
    mi.set_variant("llvm_ad_rgb")
    if text.startswith("<phase"):
        text = f'<medium type="homogeneous">{text}</medium>'
    assert mi.load_string(f'<scene version="3.9.0">{text}</scene>') is not None


@pytest.mark.parametrize("text", re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
def test_dicts_load(plugins, text):
    mi.set_variant("llvm_ad_rgb")
    assert mi.load_dict(eval(f"{{{text}}}", {"mi": mi})) is not None
