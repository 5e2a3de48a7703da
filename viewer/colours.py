"""Colours of the tissue, for pages and for markers: red, green, blue, 0 to 255.

The page has those of the cut and of the tools in `static/colours.js`.
"""

Colour = tuple[int, int, int]

TISSUE: Colour = (205, 118, 100)
CUT: Colour = (120, 8, 22)
"""Of the markers."""
OTHER_TISSUE: Colour = (120, 140, 190)
"""A tissue that is computed again, beside the recorded one."""
