"""Line plots over time for pages."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cutting_trainer.viewer.ring_buffers import Floats

BLUE, ORANGE, RED = '#1c7ed6', '#e8590c', '#c2255c'


@dataclass(frozen=True)
class Plot:
    """A plot of one or more lines.

    Attributes:
        title: without the unit.
        unit: of all lines.
        colours: by the lines' names.
        min_top: smallest maximum of the axis, which begins at zero.
    """

    title: str
    unit: str
    colours: Mapping[str, str]
    min_top: float

    def lines(self, times: Floats, *values: Floats) -> dict[str, Any]:
        """Return the plot in the format of the message `plots`.

        Args:
            times: [s], shape (n,).
            values: of each line, shape (n,).
        """
        named = zip(self.colours, values, strict=True)
        return {
            'title': self.title,
            'unit': self.unit,
            'times': np.round(times, 3).tolist(),
            'values': {name: np.round(np.nan_to_num(row), 5).tolist() for name, row in named},
            'colours': dict(self.colours),
            'least': self.min_top,
        }


FORCE = Plot('Force on the hand', 'N', {'force': BLUE}, 0.5)
DEPTH = Plot('Depth of the blade', 'mm', {'depth': RED}, 5.0)
RATES = Plot('Rates', '% of nominal', {'force loop': BLUE, 'tissue': ORANGE}, 120.0)
