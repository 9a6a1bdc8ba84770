"""The font of figures in files: DejaVu Sans with the characters of European languages only.

A PDF holds the characters that it shows. To choose them out of DejaVu's six thousand takes longer
than to draw the figure; out of a few hundred it takes no time. Shapes and kerning are DejaVu's, and
what is not in here comes from DejaVu itself.
"""

from __future__ import annotations

import functools
from pathlib import Path
from tempfile import NamedTemporaryFile

import matplotlib as mpl
from fontTools import subset
from matplotlib import font_manager

__all__ = ["short_font"]

WHOLE = "DejaVu Sans"
SHORT = "DejaVu Sans, short"
_LATIN, _GREEK, _PUNCTUATION = range(0x20, 0x180), range(0x370, 0x400), range(0x2010, 0x2027)
_CHARACTERS = (*_LATIN, *_GREEK, *_PUNCTUATION, ord("\N{MINUS SIGN}"))
_FAMILY_NAMES = (1, 16)
"""Numbers of a font's names by which it is found."""


@functools.cache
def short_font() -> str:
    """Name of the font, which is made once and kept where matplotlib keeps its own files."""
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
    with NamedTemporaryFile(dir=file.parent, delete=False) as made:  # others may be making it, too
        font.save(made)
    Path(made.name).replace(file)
