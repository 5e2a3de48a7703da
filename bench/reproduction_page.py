"""The page of `bench.reproduction`."""

from pathlib import Path
from typing import Any

import numpy as np

_PRINTED = {
    'euler': ('O(Δt²)', 'O(Δt)', 0.0016, 0.003, 0.53),
    'rk4': ('O(Δt⁵)', 'O(Δt⁴)', 0.032, 0.014, 2.28),
}
"""Tables 4.1 and 4.2: orders; largest step, calculation time [s], and their ratio."""
_NAMES = {'euler': 'Euler', 'rk4': 'RK-4'}

_PAGE = """# The thesis's results, computed again

J. Yi, *A Progressive Cutting Scheme for Surgery Simulations*, MASc thesis, Carleton University
2007, chapters 4 and 7. Written by `python -m bench.reproduction`. Its constants: E 642.55 Pa,
ν 0.47, 1050 kg/m³, damping α 10⁻⁵ 1/s and β 2·10⁻⁵ s (printed as "m * sec"). It prints the numbers
of nodes and tetrahedra of its blocks, not their coordinates: the blocks here are Delaunay meshes
with exactly those numbers. Equations 4.6 to 4.8 and the RK-4 formulas are used as corrected in
[method.md](method.md); as printed the model diverges or stands still.

## Table 4.1: order of the error

Measured on the block of 50 nodes and 100 tetrahedra, undamped, against its exact motion (all modes).

| method | single step: print | measured | global: print | measured |
|---|---|---|---|---|
{orders}

They agree. RK-4 has these orders with the velocity updated by its own stages, which the printed
formulas leave out.

## Table 4.2: largest step and efficiency

The same block, its underside fixed. Theory: forward Euler is stable up to β + α/ω², RK-4 up to
2.83/ω with so little damping, at the block's highest frequency ω = {omega:.0f} rad/s. Measured: where
a disturbance of that mode begins to grow. Calculation time is CPU time of one step.

| method | largest step: print | theory | measured | calculation: print | here | ratio: print | here |
|---|---|---|---|---|---|---|---|
{efficiency}

The printed steps do not follow from the printed constants:

- **Euler** is printed {euler_times:.0f} times above its limit, {euler_limit:.2g} s. A largest step
  of 0.0016 s needs β = 0.0016 s, or α = {alpha:.0f} 1/s: damping 80 times, or tens of millions of
  times, what section 7.2.2 says. With the stated damping Euler is of no use, and the thesis's advice to
  prefer RK-4 is right for a stronger reason than it gives.
- **RK-4** is printed {rk4_times:.1f} times above its limit. 0.032 s would need ω = 88 rad/s, a tissue
  {softer:.0f} times softer or elements {larger:.0f} times larger. It is what section 7.6 calls the time of
  the whole loop at 30 Hz ("0.032 ms", meant are seconds): most likely the loop's period was
  written down, not a limit of stability.
- **Calculation time** here is {faster:.0f} times (Euler) and {faster4:.0f} times (RK-4) shorter. Newer
  processors alone do not make a factor of thousands (100 tetrahedra are some 10⁴ operations a
  force): most likely the printed times hold the whole loop, graphics and haptics too.
- **Ratio**: the printed order, RK-4 ahead of Euler by {print_ratio:.1f}, holds with {here_ratio:.0f} here.

## 7.5: palpation

The tool pressed into the middle of the same block, two seconds at each depth, RK-4, E and ν as printed; damping α 1 1/s and β 3 ms, so that it comes to rest. The spring between tool and tissue has 200 N/m.

| depth of the tool [mm] | force on the tool [N] |
|---|---|
{palpation}

The print says: "the deformation becomes bigger while the palpating force increases", and that the
tensors stay the same; it has a picture (7.3) and no figure. Here force grows in proportion to depth, to
{linear:.1g} of it, as it must in a linear model. A frame of {period:.0f} ms costs {palp_cpu:.2g} ms of CPU.

## 7.6: cutting

A blade drawn along the block through its whole height, over 80 % of its length, in 45 steps, the
tissue moving on after each.

| | deletion: print | deletion: here | combined: print | combined: here |
|---|---|---|---|---|
| nodes and tetrahedra before | 85, 258 | {d.nodes[0]}, {d.tetrahedra[0]} | 50, 100 | {c.nodes[0]}, {c.tetrahedra[0]} |
| and after | | {d.nodes[1]}, {d.tetrahedra[1]} | | {c.nodes[1]}, {c.tetrahedra[1]} |
| size of elements | 5 mm | 5 mm | 10 mm | 10 mm |
| gap left by the cut | "big gap with the size of mesh resolution" | {d_gap:.1f} mm, {d_lost:.0f} % of the volume | follows the tool path | none, volume kept to {c_lost:.0e} |
| lag behind the tool | none | {d_lag} | "a small lag" | {c_lag:.1f} mm at most |
| one loop | | {d_cpu:.2g} ms | "0.032 ms", 30 Hz | {c_cpu:.2g} ms |

Deletion leaves {gap_h:.1f} elements' widths of gap and no lag; the combined method keeps the volume
and lags by up to {lag_h:.1f} elements: elements are split when the blade has left them. Both as
printed. The thesis's "0.032 ms" must be seconds: 30 Hz is its own figure. Loops here are the median
of cutting and one frame of motion; the first ones load compiled kernels and are no part of it.
"""


def write_page(
    file: Path,
    orders: dict[str, Any],
    efficiency: dict[str, Any],
    omega: float,
    palpation: Any,
    deletion: Any,
    combined: Any,
) -> None:
    """Writes the page.

    Args:
        file: to write.
        orders, efficiency: of table 4.1 and 4.2 by integrator.
        omega: highest frequency of the block [rad/s].
        palpation: of 7.5.
        deletion, combined: of 7.6.
    """
    euler, rk4 = efficiency['euler'], efficiency['rk4']
    ratio = {name: row.measured / row.cpu for name, row in efficiency.items()}
    stiffness = palpation.force / palpation.depth
    rounding = max(abs(combined.lost), 1e-16)
    text = _PAGE.format(
        orders='\n'.join(_order(name, order) for name, order in orders.items()),
        efficiency='\n'.join(_efficiency(name, row) for name, row in efficiency.items()),
        omega=omega,
        euler_times=0.0016 / euler.theory,
        euler_limit=euler.theory,
        alpha=0.0016 * omega**2,
        rk4_times=0.032 / rk4.theory,
        softer=(0.032 / rk4.theory) ** 2,
        larger=0.032 / rk4.theory,
        faster=0.003 / euler.cpu,
        faster4=0.014 / rk4.cpu,
        print_ratio=2.28 / 0.53,
        here_ratio=ratio['rk4'] / ratio['euler'],
        palpation='\n'.join(
            f'| {1e3 * depth:.0f} | {force:.3f} |'
            for depth, force in zip(palpation.depth, palpation.force, strict=True)
        ),
        linear=float(np.ptp(stiffness) / stiffness.mean()),
        period=1e3 * palpation.period,
        palp_cpu=1e3 * palpation.cpu,
        d=deletion,
        c=combined,
        d_gap=1e3 * deletion.gap,
        d_lost=100 * deletion.lost,
        d_lag='none' if deletion.lag <= 0 else f'{1e3 * deletion.lag:.1f} mm',
        c_lost=rounding,
        c_lag=1e3 * combined.lag,
        d_cpu=1e3 * deletion.cpu[0],
        c_cpu=1e3 * combined.cpu[0],
        gap_h=deletion.gap / 0.005,
        lag_h=combined.lag / 0.01,
    )
    file.write_text(text, encoding='utf-8')


def _order(name: str, order: Any) -> str:
    single, total, *_ = _PRINTED[name]
    return f'| {_NAMES[name]} | {single} | Δt^{order.single:.2f} | {total} | Δt^{order.total:.2f} |'


def _efficiency(name: str, row: Any) -> str:
    _, _, step, time, ratio = _PRINTED[name]
    return (
        f'| {_NAMES[name]} | {step:g} s | {row.theory:.3g} s | {row.measured:.3g} s '
        f'| {time:g} s | {row.cpu:.2g} s | {ratio:g} | {row.measured / row.cpu:.3g} |'
    )
