"""Material constants from recorded hands and forces: likelihood, uncertainty, identifiability.

The unknowns are logarithms of constants. A residual is the mean of one force component over a
window, less the computed one, over its standard deviation. That has the noise of the sensor and an
error of the model in proportion to the force. Their common scale is estimated from the residuals,
whose correlation in time widens it. The posterior is Gaussian around its maximum (Laplace; MacKay,
*Information Theory, Inference, and Learning Algorithms*, 2003, chapter 27). A bootstrap over bags,
one Gauss-Newton step each, checks it: hands differ by more than noise.

All computed forces may be off by one share, by the mesh, the law or the device. That moves the
estimates and does not average out, so it widens the intervals by itself.

The estimates of a finer mesh differ from those of the recorded one; that change
is extrapolated, with an uncertainty of its own (Roache, *Journal of Fluids Engineering* 116, 1994).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm
from scipy.stats import t as student

from cutting_trainer.tissue_sim.material_presets import PRESETS

Floats = NDArray[np.float64]

PARAMETERS = {
    'youngs_modulus': 'Pa',
    'stiffening': '-',
    'toughness': 'J/m^2',
    'blade_friction': 'N/m',
    'friction': '-',
}
"""Constants of `tissue.material` that can be identified, and their units."""
FORCE_SPREAD = 0.05
"""Standard deviation of that share: forces under a tool differ by up to 10 % between meshes."""
_BY_FORCE = ('youngs_modulus', 'toughness', 'blade_friction')
"""Constants in proportion to the forces of a path: it scales them all alike, but for inertia."""
MESH_LEFT, MESH_LEFT_SPREAD = 1.0 / 3.0, 1.0 / 3.0
"""Mean and standard deviation of what a finer mesh would still change, as a share of what the first
refinement changed: a third where errors are quadratic in the size of elements; linear ones (1) and
none (0) lie within two deviations."""
WINDOW_S = 0.05
MODEL_ERROR = 0.1
"""Error of the model as a share of the force, before its scale is estimated."""
MIN_BOOTSTRAP_BAGS = 5
RESAMPLES = 2000
_MIN_PRESETS = 3
_MIN_SPREAD = float(np.log(2.0))
_FREE_SPREAD = float(np.log(10.0)) / 2.0
"""Standard deviation of the logarithm without presets: 95 % lie within a factor of ten."""
_UNTOUCHED = 0.9
"""Share of the prior's width that is left where bags say nothing about a constant."""
_UNCLEAR = 0.3
"""Half of an interval, as a logarithm, above which the correlated constant is named."""
_CORRELATED = 0.9
_SCALE_ROUNDS = 3
_TAIL = float(norm.ppf(0.975))
"""Half of an interval of 95 % of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Prior:
    """Lognormal prior of a constant.

    Attributes:
        median: in the unit of the constant.
        spread: standard deviation of the logarithm.
        source: origin, in a few words.
    """

    median: float
    spread: float
    source: str

    @property
    def text(self) -> str:
        """Return the range that has 95 % of the prior, in a few words."""
        return f'{self.median:.3g}, within a factor of {np.exp(1.96 * self.spread):.2g}'


def prior_of(name: str, recorded: float) -> Prior:
    """Return the prior of a constant from the presets, or around its recorded value.

    Args:
        name: of the constant.
        recorded: value in the recorded scene.
    """
    values = [preset.values[name] for preset in PRESETS.values() if name in preset.values]
    if len(set(values)) >= _MIN_PRESETS:
        logs = np.log(values)
        spread = max(float(logs.std(ddof=1)), _MIN_SPREAD)
        return Prior(float(np.exp(logs.mean())), spread, f'{len(values)} presets')
    median = recorded or {'stiffening': 9.2, 'friction': 0.1}.get(name, 1.0)
    source = 'the scene' if recorded else 'no source'
    return Prior(median, _FREE_SPREAD, f'{source}, within a factor of ten')


def window_means(times: Floats, values: Floats) -> Floats:
    """Return the means of force components over windows of `WINDOW_S`.

    Args:
        times: of the ticks [s], shape (n,).
        values: [N], shape (n, 3).

    Returns:
        Shape (windows, 3); a window without a tick is left out.
    """
    window = np.floor((times - times[0]) / WINDOW_S + 1e-9).astype(int)
    _, of, count = np.unique(window, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(of, values[:, i]) / count for i in range(3)], axis=1)


def deviations(times: Floats, felt: Floats, noise: float) -> Floats:
    """Return the standard deviation of each window [N], shape (windows, 3), up to a common scale.

    Args:
        times: of the ticks [s], shape (n,).
        felt: recorded force [N], shape (n, 3).
        noise: of the sensor for one sample of one component [N].
    """
    means = window_means(times, felt)
    samples = max(len(times) / len(means), 1.0)
    size = np.linalg.norm(means, axis=1, keepdims=True)
    return np.asarray(np.sqrt(noise**2 / samples + (MODEL_ERROR * size) ** 2) * np.ones(3), float)


@dataclass(frozen=True)
class Linearised:
    """Problem around its solution.

    Attributes:
        names: of the unknown constants.
        at: their logarithms, shape (p,).
        residuals: of each bag, each shape (m,); recorded less computed.
        jacobians: of the computed values, each shape (m, p).
        prior_mean, prior_spread: shape (p,).
        confidence: of the intervals.
        deviations: of the window means of each bag [N], each shape (windows, 3), before the common
            scale; () where they are not needed.
        mesh_change: of the unknowns from the recorded mesh to the refined one that this problem is
            about, shape (p,); None: it is about the recorded one.
    """

    names: tuple[str, ...]
    at: Floats
    residuals: Sequence[Floats]
    jacobians: Sequence[Floats]
    prior_mean: Floats
    prior_spread: Floats
    confidence: float = 0.95
    deviations: Sequence[Floats] = ()
    mesh_change: Floats | None = None

    @cached_property
    def scale(self) -> float:
        """Variance of a residual, widened by the correlation of neighbours in time."""
        scale = _variance(self.residuals, len(self.names))
        for _ in range(_SCALE_ROUNDS):
            step = self.step(scale=scale)
            left = [r - j @ step for r, j in zip(self.residuals, self.jacobians, strict=True)]
            scale = _variance(left, len(self.names))
        return scale

    @cached_property
    def information(self) -> Floats:
        """Information of the bags without the prior, shape (p, p)."""
        return np.asarray(sum(j.T @ j for j in self.jacobians) / self.scale, float)

    @cached_property
    def covariance(self) -> Floats:
        """Posterior covariance of the unknowns, shape (p, p)."""
        return np.asarray(np.linalg.inv(self.information + np.diag(self.prior_spread**-2.0)), float)

    def step(self, weights: Floats | None = None, scale: float = 0.0) -> Floats:
        """Return the Gauss-Newton step to the maximum of the posterior, shape (p,).

        Args:
            weights: how often each bag counts, shape (bags,); None: once.
            scale: variance of a residual; 0: that of the problem.
        """
        scale = scale or self.scale
        counts = np.ones(len(self.residuals)) if weights is None else weights
        parts = list(zip(counts, self.jacobians, self.residuals, strict=True))
        matrix = sum(n * (j.T @ j) for n, j, _ in parts) / scale
        precision = self.prior_spread**-2.0
        pull = sum(n * (j.T @ r) for n, j, r in parts) / scale
        pull = pull + precision * (self.prior_mean - self.at)
        return np.asarray(np.linalg.solve(matrix + np.diag(precision), pull), float)

    @cached_property
    def bootstrap_spread(self) -> Floats | None:
        """Return standard deviations over bags drawn with replacement, shape (p,).

        They are those of a normal distribution with the same interval of 95 %: a rare draw without
        any cut would decide a second moment. None: there are fewer than `MIN_BOOTSTRAP_BAGS`.
        """
        bags = len(self.residuals)
        if bags < MIN_BOOTSTRAP_BAGS:
            return None
        random = np.random.default_rng(0)
        draws = random.multinomial(bags, np.full(bags, 1.0 / bags), RESAMPLES)
        steps = np.array([self.step(draw.astype(float)) for draw in draws])
        low, high = np.quantile(steps, [0.025, 0.975], axis=0)
        return np.asarray((high - low) / (2.0 * _TAIL) * np.sqrt(bags / (bags - 1.0)))

    @cached_property
    def half_widths(self) -> Floats:
        """Half of the interval of each unknown, shape (p,).

        It is the wider of Laplace and bootstrap, and independent of that the common error of all
        forces and that of the mesh.
        """
        tail = 0.5 + self.confidence / 2.0
        widths = np.sqrt(np.diag(self.covariance)) * norm.ppf(tail)
        spread = self.bootstrap_spread
        if spread is not None:
            widths = np.maximum(widths, spread * student.ppf(tail, len(self.residuals) - 1))
        common = FORCE_SPREAD * np.isin(self.names, _BY_FORCE)
        if self.mesh_change is not None:
            common = np.hypot(common, MESH_LEFT_SPREAD * self.mesh_change)
        widths = np.hypot(widths, common * norm.ppf(tail))
        # Bags that say nothing leave the prior, and no more than that.
        return np.asarray(np.minimum(widths, self.prior_spread * norm.ppf(tail)))

    @cached_property
    def estimates(self) -> Floats:
        """The unknowns at the maximum of the posterior, shape (p,), extrapolated to a fine mesh."""
        found = self.at + self.step()
        return found if self.mesh_change is None else found + MESH_LEFT * self.mesh_change


def _variance(residuals: Sequence[Floats], unknowns: int) -> float:
    """Return the variance of a residual, widened by the correlation of neighbours in time."""
    total = sum(float(r @ r) for r in residuals)
    count = sum(int(np.count_nonzero(r)) for r in residuals)
    lagged = sum(float(r[3:] @ r[:-3]) for r in residuals)  # three components a window
    rho = min(max(lagged / total, 0.0), 0.9) if total > 0.0 else 0.0
    return max(total / max(count - unknowns, 1), 1e-12) * (1.0 + rho) / (1.0 - rho)


@dataclass(frozen=True)
class Estimate:
    """A constant with its interval.

    Attributes:
        value, low, high: in its unit.
        laplace, bootstrap: standard deviations of the logarithm; NaN: too few bags.
        prior: of the constant.
    """

    value: float
    low: float
    high: float
    laplace: float
    bootstrap: float
    prior: Prior


def estimates_of(problem: Linearised, priors: Mapping[str, Prior]) -> dict[str, Estimate]:
    """Return each constant with its interval."""
    spread = problem.bootstrap_spread
    found = {}
    for i, (name, at) in enumerate(zip(problem.names, problem.estimates, strict=True)):
        half = problem.half_widths[i]
        found[name] = Estimate(
            value=float(np.exp(at)),
            low=float(np.exp(at - half)),
            high=float(np.exp(at + half)),
            laplace=float(np.sqrt(problem.covariance[i, i])),
            bootstrap=float('nan') if spread is None else float(spread[i]),
            prior=priors[name],
        )
    return found


def identifiability(problem: Linearised) -> list[str]:
    """Return a sentence for each constant that the bags do not determine."""
    sentences = []
    spreads = np.sqrt(np.diag(problem.covariance))
    correlation = problem.covariance / np.outer(spreads, spreads)
    for i, name in enumerate(problem.names):
        alone = 1.0 / np.sqrt(problem.information[i, i] + problem.prior_spread[i] ** -2.0)
        if alone > _UNTOUCHED * problem.prior_spread[i]:
            sentences.append(
                f'these bags do not touch {name}: the force hardly changes with it, and its value '
                'is that of the prior'
            )
            continue
        if problem.half_widths[i] < _UNCLEAR:
            continue
        others = np.abs(correlation[i])
        others[i] = 0.0
        other = int(others.argmax())
        sentences.append(
            f'these bags cannot tell {name} from {problem.names[other]}'
            if others[other] > _CORRELATED
            else f'these bags determine {name} poorly, to a factor of '
            f'{np.exp(problem.half_widths[i]):.2f}'
        )
    return sentences
