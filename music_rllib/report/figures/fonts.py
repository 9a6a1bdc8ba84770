"""The font of figures in files: DejaVu Sans with the characters of European languages only.

A PDF embeds the characters that it shows. Selecting them from the six thousand of DejaVu takes
longer than drawing the figure; selecting them from a few hundred takes no time. Shapes and kerning
are those of DejaVu, which also has all other characters.
"""

from __future__ import annotations

import functools
from pathlib import Path
from tempfile import NamedTemporaryFile

import matplotlib as mpl
from fontTools import subset
from matplotlib import font_manager

WHOLE = "DejaVu Sans"
SHORT = "DejaVu Sans, short"
_LATIN, _GREEK, _PUNCTUATION = range(0x20, 0x180), range(0x370, 0x400), range(0x2010, 0x2027)
_CHARACTERS = (*_LATIN, *_GREEK, *_PUNCTUATION, ord("\N{MINUS SIGN}"))
_FAMILY_NAMES = (1, 16)
"""Ids of the names by which a font is found: family, and typographic family."""


@functools.cache
def short_font() -> str:
    """Name of the font, which is made once and kept in matplotlib's cache folder."""
    file = Path(mpl.get_cachedir()) / f"music_rllib-{mpl.__version__}.ttf"
    if not file.is_file():
        _make(file)
    font_manager.fontManager.addfont(file)
    return SHORT


def _make(file: Path) -> None:
    options = subset.Options(glyph_names=True)
    options.drop_tables += ["FFTM"]
    font = subset.load_font(str(font_manager.findfont(WHOLE)), options)
    chosen = subset.Subsetter(options)
    chosen.populate(unicodes=_CHARACTERS)
    chosen.subset(font)
    for name in font["name"].names:
        if name.nameID in _FAMILY_NAMES:
            name.string = SHORT
    with NamedTemporaryFile(dir=file.parent, delete=False) as new:
        font.save(new)
    Path(new.name).replace(file)  # at once: other processes may be making it, too
