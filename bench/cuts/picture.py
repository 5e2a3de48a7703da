"""Output of `trainer bench cuts`: docs/cut-methods.md, its picture, the table as CSV."""

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

from bench.common.marked_page import page_in, put_table
from bench.cuts.comparison import METHODS, Cut, Row, distances, mean_edge
from bench.cuts.strokes import Stroke
from cutting_trainer.cutting.cut_invariants import pieces
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh
from cutting_trainer.tissue_sim.mesh.topology import CUT

_TISSUE = np.array([0.80, 0.45, 0.38])
_MAX_DISTANCE = 0.5
"""Upper end of the colour scale, in units of h."""


def write_all(
    folder: Path,
    rows: list[Row],
    shown: list[Cut],
    stroke: Stroke,
    spreads: dict[str, NDArray[np.float64]],
) -> None:
    """Write the tables of the page, the CSV file and the picture.

    Args:
        folder: existing folder with cut-methods.md; the picture goes to `images` in it.
        rows: rows of the table.
        shown: results of each method on the first stroke.
        stroke: first stroke.
        spreads: results of random planes by tissue, as from `comparison.spread`.

    Raises:
        SessionError: there is no such page, or it has no marks for the tables.
    """
    page = page_in(folder, 'cut-methods.md')
    put_table(page, 'methods', table(rows))
    put_table(page, 'planes', spread_table(spreads))
    (folder / 'images').mkdir(exist_ok=True)
    with (folder / 'cut-methods.csv').open('w', newline='') as out:
        writer = csv.writer(out, lineterminator='\n')
        writer.writerow([field.name for field in fields(Row)])
        writer.writerows(astuple(row) for row in rows)
    draw(shown, stroke, rows).savefig(folder / 'images' / 'cut-methods.png', dpi=130)


def table(rows: list[Row]) -> list[str]:
    """Return the rows as a table in Markdown."""
    head = 'stroke | method | distance [h] rms, largest | elements | step shrink | ms a batch'
    lines = [f'| {head} |', '|---|---|' + '---:|' * 4]
    for row in rows:
        growth = 100 * (row.elements_after / row.elements_before - 1)
        cells = (
            row.stroke,
            f'`{row.method}`',
            f'{row.rms_distance_h:.3f}, {row.largest_distance_h:.2f}',
            f'{growth:+.0f} %',
            f'{row.step_shrink:.1f}',
            f'{row.median_ms:.1f}',
        )
        lines.append(f'| {" | ".join(cells)} |')
    return lines


def spread_table(spreads: dict[str, NDArray[np.float64]]) -> list[str]:
    """Return the results of random planes as a table in Markdown."""
    lines = ['| tissue | planes | distance, rms [h] | largest [h] | step shrink |']
    lines.append('|---|---:|---:|---:|---:|')
    for name, values in spreads.items():
        columns = [
            ', '.join(f'{np.quantile(column, q):.{digits}f}' for q in (0.5, 0.9, 1.0))
            for column, digits in zip(values.T, (4, 2, 1), strict=True)
        ]
        lines.append(f'| {name} | {len(values)} | {" | ".join(columns)} |')
    return lines


def draw(shown: list[Cut], stroke: Stroke, rows: list[Row]) -> Figure:
    """Return the block, one half taken away, by method.

    The cut surface is coloured by its error.
    """
    figure = Figure(figsize=(15.0, 3.9), layout='constrained')
    h = mean_edge(TetMesh(stroke.nodes, stroke.tetrahedra))
    scale = ScalarMappable(Normalize(0.0, _MAX_DISTANCE), 'YlGnBu')
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
    """Return the tetrahedra of the pieces behind the stroke, shape (m,)."""
    part = pieces(mesh)
    height = (
        mesh.rest[mesh.tetrahedra].mean(axis=1) - stroke.paths[0].mean(axis=(0, 1))
    ) @ _normal(stroke)
    mean = np.bincount(part, height) / np.bincount(part)
    return np.asarray(mean[part] < 0)
