"""What `trainer compare-cuts` writes: docs/cut-methods.md, its picture, the table as CSV."""

import csv
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from cutting.checks import pieces
from session.measure.cut_comparison import GROWTH, METHODS, REPEATS, Cut, Row, distances, mean_edge
from session.measure.cut_strokes import Stroke
from tissue_sim.mesh import TetMesh
from tissue_sim.topology import CUT

_TISSUE = np.array([0.80, 0.45, 0.38])
_FARTHEST = 0.5
"""Distance that the scale of colours ends at, in units of h."""

_PAGE = """# Methods of cutting, compared

Written by `./trainer compare-cuts`: the same strokes by each method, in a mesh at rest. The tissue
is a block of {block} well-shaped tetrahedra (body-centred cubes, inner nodes displaced by up to
8 %, numbers shuffled), and the liver of the demo, where the cut ends inside. All digits are in
[cut-methods.csv](cut-methods.csv).

![The block opened after the same straight stroke by each method](images/cut-methods.png)

{table}

- **distance**: of the cut surface from the blade's path, in units of the mean edge h; root of the
  mean square over the area, and largest.
- **step shrink**: highest frequency after the cut over that before, with the masses that the tissue
  has; a stable step is shorter by so much. **added mass**: what the simulation adds to small nodes
  beyond a growth of {growth:g}, so that its step shrinks by no more than that.
- **ms a batch**: cutting, adjacency, surface, tensors, masses and bound of the frequency together,
  in processor time, median and largest, each batch the best of {repeats} runs. **elements a
  batch**: tetrahedra taken out or replaced, in the mean. In the same run one RK4 step of 10,000
  tetrahedra took {rk4:.2f} ms: a batch of `combined` costs {ratio:.0f} of them.

## Planes of any direction

What `combined` makes of {planes} planes drawn at random through the same two tissues, right
through: median / 90 % / largest. Some of them meet an edge of the tissue at a small angle: a node
there can only slide along that edge, so it stays off the surface, or makes small elements.

{spread}

{verdict}
"""


def write_all(
    folder: Path,
    rows: list[Row],
    shown: list[Cut],
    stroke: Stroke,
    rk4: float,
    spreads: dict[str, NDArray[np.float64]],
) -> None:
    """Writes the page, the table and the picture.

    Args:
        folder: that exists; the picture goes to `images` in it.
        rows: the table.
        shown: the first stroke as each method cut it.
        stroke: that stroke.
        rk4: milliseconds of the yardstick.
        spreads: by tissue, what random planes came to, as from `compare_cuts.spread`.
    """
    (folder / 'images').mkdir(exist_ok=True)
    with (folder / 'cut-methods.csv').open('w', newline='') as out:
        writer = csv.writer(out, lineterminator='\n')
        writer.writerow([field.name for field in fields(Row)])
        writer.writerows(astuple(row) for row in rows)
    page = _PAGE.format(
        block=rows[0].elements_before,
        table=table(rows),
        growth=GROWTH,
        repeats=REPEATS,
        rk4=rk4,
        ratio=np.median([row.median_ms for row in rows if row.method == 'combined']) / rk4,
        verdict=verdict(rows),
        planes=sum(map(len, spreads.values())),
        spread=spread_table(spreads),
    )
    (folder / 'cut-methods.md').write_text(page)
    draw(shown, stroke, rows).savefig(folder / 'images' / 'cut-methods.png', dpi=130)


def table(rows: list[Row]) -> str:
    """The rows as a table in Markdown."""
    head = (
        'stroke | method | distance [h] rms / largest | elements | step shrink | added mass [%]'
        ' | lost mass [%] | pieces | ms a batch, median / largest | elements a batch'
    )
    lines = [f'| {head} |', '|---|---|' + '---:|' * 8]
    for row in rows:
        growth = 100 * (row.elements_after / row.elements_before - 1)
        cells = (
            row.stroke,
            f'`{row.method}`',
            f'{row.rms_distance_h:.3f} / {row.largest_distance_h:.2f}',
            f'{growth:+.0f} %',
            f'{row.step_shrink:.1f}',
            f'{row.added_mass_percent:.2f}',
            f'{abs(row.lost_mass_percent):.1f}',
            str(row.pieces),
            f'{row.median_ms:.1f} / {row.largest_ms:.1f}',
            f'{row.cut_elements / row.batches:.0f}',
        )
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines)


def spread_table(spreads: dict[str, NDArray[np.float64]]) -> str:
    """What random planes came to, as a table in Markdown."""
    lines = ['| tissue | planes | distance, rms [h] | largest [h] | step shrink |']
    lines.append('|---|---:|---:|---:|---:|')
    for name, values in spreads.items():
        columns = [
            ' / '.join(f'{np.quantile(column, q):.{digits}f}' for q in (0.5, 0.9, 1.0))
            for column, digits in zip(values.T, (4, 2, 1), strict=True)
        ]
        lines.append(f'| {name} | {len(values)} | {" | ".join(columns)} |')
    return '\n'.join(lines)


def verdict(rows: list[Row]) -> str:
    """One sentence on what the table shows."""

    def span(method: str, name: str, form: str) -> str:
        values = [getattr(row, name) for row in rows if row.method == method]
        return f'{min(values):{form}} to {max(values):{form}}'

    return (
        f'`combined` follows the blade to {span("combined", "rms_distance_h", ".3f")} h '
        '(the most on the arc, which flat triangles cannot follow), at a step '
        f'{span("combined", "step_shrink", ".1f")} times shorter; `separate` is off by '
        f'{span("separate", "rms_distance_h", ".2f")} h, `delete` loses '
        f'{span("delete", "lost_mass_percent", ".0f")} % of the tissue, and the slivers of '
        f'`subdivide` cost {span("subdivide", "step_shrink", ".0f")} times the steps.'
    )


def draw(shown: list[Cut], stroke: Stroke, rows: list[Row]) -> Figure:
    """The block, one half taken away, by method; the cut surface is coloured by its error."""
    figure = Figure(figsize=(15.0, 3.9), layout='constrained')
    h = mean_edge(TetMesh(stroke.nodes, stroke.tetrahedra))
    scale = ScalarMappable(Normalize(0.0, _FARTHEST), 'YlGnBu')
    all_axes = []
    for k, (method, cut, row) in enumerate(zip(METHODS, shown, rows, strict=False)):
        axes: Any = figure.add_subplot(1, len(shown), k + 1, projection='3d')
        _draw_half(axes, cut.mesh, stroke, h, scale)
        axes.set_title(
            f'{method}\n{row.rms_distance_h:.3f} h off the blade (rms)\nstable step ÷ '
            f'{row.step_shrink:.1f}, mass lost {abs(row.lost_mass_percent):.0f} %',
            fontsize=11,
        )
        all_axes.append(axes)
    bar = figure.colorbar(scale, ax=all_axes, shrink=0.8, pad=0.01, extend='max')
    bar.set_label('distance of the cut surface\nfrom the path of the blade [h]')
    return figure


def _draw_half(axes: Any, mesh: TetMesh, stroke: Stroke, h: float, scale: ScalarMappable) -> None:
    kept = _behind(mesh, stroke)[mesh.triangle_face // 4]
    corners = mesh.rest[mesh.triangles[kept]] * 1e3
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = np.tile(_TISSUE, (len(corners), 1))
    away = distances(mesh, stroke.paths, h)[0].reshape(-1, 7).mean(axis=1)
    opened = mesh.triangle_kind == CUT
    colours[opened[kept]] = scale.to_rgba(away[kept[opened]])[:, :3]
    light = _normal(stroke) + np.array([0.0, 0.0, 0.5])
    colours *= (0.72 + 0.28 * np.clip(normals @ light, -1, 1))[:, None]
    axes.add_collection3d(
        Poly3DCollection(corners, facecolors=np.clip(colours, 0, 1), edgecolors='black', lw=0.3)
    )
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.2)
    normal = _normal(stroke)
    axes.view_init(elev=30, azim=np.degrees(np.arctan2(normal[1], normal[0])) + 24)
    axes.set_axis_off()


def _normal(stroke: Stroke) -> NDArray[np.float64]:
    path = stroke.paths[0]
    across = np.cross(path[-1, 0] - path[0, 0], path[0, 0] - path[0, 1])
    return np.asarray(across / np.linalg.norm(across))


def _behind(mesh: TetMesh, stroke: Stroke) -> NDArray[np.bool_]:
    """The tetrahedra of the pieces behind the stroke, shape (m,)."""
    part = pieces(mesh)
    height = (
        mesh.rest[mesh.tetrahedra].mean(axis=1) - stroke.paths[0].mean(axis=(0, 1))
    ) @ _normal(stroke)
    mean = np.bincount(part, height) / np.bincount(part)
    return np.asarray(mean[part] < 0)
