"""Search for the constants under which computed forces are nearest to recorded ones."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares
from scipy.stats import qmc

from cutting_trainer.studies.identification import (
    Linearised,
    Prior,
    deviations,
    window_means,
)

Floats = NDArray[np.float64]

DIFFERENCE = 0.2
"""Step of the central differences of logarithms: a cut goes on from element to element, and a
smaller step divides its jumps by less."""
START_POINTS = 3
"""Points of the start's design for each unknown."""
MAX_STEPS = 8
MAX_SEARCHES = 4
"""Searches, with the first: each other one begins where an end of the differences fits better."""
_START_BAGS = 3
_START_SPREAD = 1.5
"""Half of the design's range, and _BOUND that of the search, in spreads of the prior."""
_BOUND = 3.0
_NEAR = DIFFERENCE / 2
"""Distance from which slopes are taken again, and a further step is worth a search."""
_TOLERANCE = 3e-3
"""A search ends where a step is below this share of the logarithms, which is 3 % of a constant, or
where it gains less than this share of the loss. A Gauss-Newton step follows."""
_FAILED = 10.0
"""Residual of a point that cannot be computed, in recorded forces."""
_SEED = 0
_JUMP_WINDOWS = 5
"""Windows over which the variance of jumps is averaged: they come earlier or later."""


@dataclass(frozen=True)
class Observation:
    """Recorded force of a bag.

    Attributes:
        times: of the ticks [s], shape (n,).
        felt: force on the hand [N], shape (n, 3).
    """

    times: Floats
    felt: Floats


Point = tuple[float, ...]
"""Values of the unknown constants, in their order and units."""
Compute = Callable[[Iterable[tuple[int, Point]]], dict[tuple[int, Point], Floats]]
"""Returns computed forces [N], shape (n, 3), by number of bag and point; NaN where it failed."""
Slopes = dict[tuple[int, int], Floats]
"""Change of the window means with a logarithm [N], shape (windows, 3), by number of bag and of the
unknown."""


class Fit:
    """Maximum of the posterior, over re-simulations in parallel.

    Args:
        observations: of the bags.
        priors: of the unknowns, by name.
        noise: of the force for one sample of one component [N].
        compute: re-simulates.
        lead: slopes on another mesh by their place, which serve until this fit has some.

    Attributes:
        slopes: taken so far, by the logarithms of the constants, shape (p,).
    """

    def __init__(
        self,
        observations: Sequence[Observation],
        priors: dict[str, Prior],
        noise: float,
        compute: Compute,
        lead: Sequence[tuple[Floats, Slopes]] = (),
    ) -> None:
        self._observations, self._priors, self._compute = observations, priors, compute
        self._lead = lead
        self._without_jumps = [deviations(o.times, o.felt, noise) for o in observations]
        self._deviations = list(self._without_jumps)
        self._mean = np.log([prior.median for prior in priors.values()])
        self._spread = np.array([prior.spread for prior in priors.values()])
        self._known: dict[tuple[int, Point], Floats] = {}
        self._untouched: set[tuple[int, int]] = set()
        self.slopes: list[tuple[Floats, Slopes]] = []
        self._scale = 1.0

    def solve(self, begin: Floats, confidence: float) -> Linearised:
        """Return the problem linearised around its solution.

        Args:
            begin: logarithms of the constants where the search begins, shape (p,).
            confidence: of the intervals.
        """
        # Of the prior only the share counts that the fit of the start leaves to it.
        misfit = np.concatenate(self._residuals(begin))
        self._scale = float(np.sqrt(np.mean(misfit**2))) or 1.0
        bound = _BOUND * self._spread
        low, high = np.minimum(self._mean, begin) - bound, np.maximum(self._mean, begin) + bound
        at = begin
        for _ in range(MAX_SEARCHES):
            at = self._search(at, low, high)
            better = self._better_end(at, low, high)
            if better is not None:
                at = better
            elif self._rest(at) <= _NEAR:
                break
        self._slopes_at(at)
        self._allow_for_jumps(at)
        return Linearised(
            names=tuple(self._priors),
            at=at,
            residuals=self._residuals(at),
            jacobians=self._jacobians(at),
            prior_mean=self._mean,
            prior_spread=self._spread,
            confidence=confidence,
            deviations=self._deviations,
        )

    def _search(self, at: Floats, low: Floats, high: Floats) -> Floats:
        """Return the end of a search from a point, within bounds, each of shape (p,)."""
        found = least_squares(
            self._objective,
            at,
            jac=self._slope,
            bounds=(low, high),
            x_scale=self._spread,
            loss='soft_l1',
            xtol=_TOLERANCE,
            ftol=_TOLERANCE,
            max_nfev=MAX_STEPS,
        )
        return np.asarray(found.x)

    def _better_end(self, at: Floats, low: Floats, high: Floats) -> Floats | None:
        """Return the best end of the central differences that fits better than a point, or None.

        Jumps of a cut stop a search where a step away the fit is better. Slopes are taken here.

        Args:
            at: logarithms of the constants, and
            low, high: their bounds, each shape (p,).
        """
        self._slopes_at(at)
        ends = [np.log(end) for pair in self._ends(at) for end in pair]
        within = [end for end in ends if (low <= end).all() and (end <= high).all()]
        best = min([at, *within], key=lambda end: _loss(self._objective(end)))
        return None if best is at else np.asarray(best)

    def forces(self, at: Floats) -> list[Floats]:
        """Return the computed forces of all bags [N], each of shape (n, 3)."""
        point = self._point(at)
        bags = range(len(self._observations))
        self._need([(bag, point) for bag in bags])
        return [self._known[bag, point] for bag in bags]

    def start(self, recorded: Floats) -> Floats:
        """Return the best point of a Latin hypercube and the recorded values, on a few bags.

        Args:
            recorded: logarithms of the constants of the scene, shape (p,); NaN: it has none.
        """
        recorded = np.where(np.isfinite(recorded), recorded, self._mean)
        unknowns = len(self._mean)
        design = qmc.LatinHypercube(unknowns, rng=np.random.default_rng(_SEED))
        samples = 2.0 * design.random(START_POINTS * unknowns) - 1.0
        points = np.vstack(
            [recorded, self._mean, self._mean + _START_SPREAD * self._spread * samples]
        )
        few = np.linspace(0, len(self._observations) - 1, _START_BAGS).astype(int)
        bags = sorted(set(few.tolist()))
        self._need([(bag, self._point(at)) for at in points for bag in bags])
        # As the search weighs them: a window without recorded force must not decide.
        costs = [
            sum(_loss(self._residual(bag, at)) for bag in bags)
            + float(np.sum(((at - self._mean) / self._spread) ** 2))
            for at in points
        ]
        return np.asarray(points[int(np.argmin(costs))])

    def _objective(self, at: Floats) -> Floats:
        away = (at - self._mean) / self._spread
        return np.concatenate([*self._residuals(at), away * self._scale]) / self._scale

    def _slope(self, at: Floats) -> Floats:
        prior = np.diag(self._scale / self._spread)
        return np.vstack([*(-j for j in self._jacobians(at)), prior]) / self._scale

    def _residuals(self, at: Floats) -> list[Floats]:
        self.forces(at)
        return [self._residual(bag, at) for bag in range(len(self._observations))]

    def _residual(self, bag: int, at: Floats) -> Floats:
        computed, felt = self._known[bag, self._point(at)], self._observations[bag].felt
        if np.isnan(computed).any():
            return _FAILED * self._weighted(bag, felt)
        return self._weighted(bag, felt - computed)

    def _jacobians(self, at: Floats) -> list[Floats]:
        """Return slopes of the weighted window means near a point, each of shape (3 windows, p)."""
        slopes, unknowns = self._slopes_near(at), range(len(at))
        return [
            np.column_stack([self._divided(bag, slopes[bag, i]) for i in unknowns])
            for bag in range(len(self._observations))
        ]

    def _slopes_near(self, at: Floats) -> Slopes:
        """Return the slopes that are nearest to a point; take some there if none are near."""
        known = self.slopes or self._lead
        away = [float(np.abs(at - centre).max()) for centre, _ in known]
        if away and min(away) < _NEAR:
            return known[int(np.argmin(away))][1]
        return self._slopes_at(at)

    def _slopes_at(self, at: Floats) -> Slopes:
        """Take the slopes at a point, and keep them unless one is of an end that failed."""
        pairs = [(b, i) for b in range(len(self._observations)) for i in range(len(at))]
        ends, middle = self._ends(at), self.forces(at)
        self._need([(bag, ends[i][1]) for bag, i in pairs])
        for bag, i in self._untouched:  # a weaker tissue is cut first
            if np.array_equal(self._known[bag, ends[i][1]], middle[bag]):
                self._known.setdefault((bag, ends[i][0]), middle[bag])
        self._need([(bag, ends[i][0]) for bag, i in pairs])
        slopes, complete = {}, True
        for bag, i in pairs:
            up, down = (self._known[bag, point] for point in ends[i])
            failed = [bool(np.isnan(end).any()) for end in (up, down)]
            width = 2.0 * DIFFERENCE if not any(failed) else DIFFERENCE
            up, down = (middle[bag] if failed[0] else up), (middle[bag] if failed[1] else down)
            slopes[bag, i] = window_means(self._observations[bag].times, (up - down) / width)
            if any(failed):
                complete = False
            elif np.array_equal(up, down):
                self._untouched.add((bag, i))
            else:
                self._untouched.discard((bag, i))
        if complete and not any(np.array_equal(at, centre) for centre, _ in self.slopes):
            self.slopes.append((at, slopes))
        return slopes

    def _rest(self, at: Floats) -> float:
        """Return the largest change of a logarithm in the step that is left at a point."""
        slope, residuals = self._slope(at), self._objective(at)
        weighted = slope / np.hypot(1.0, residuals)[:, None]
        step = np.linalg.lstsq(weighted.T @ slope, weighted.T @ residuals, rcond=None)[0]
        return float(np.abs(step).max())

    def _ends(self, at: Floats) -> list[tuple[Point, Point]]:
        """Return the ends of the central difference along each unknown."""
        steps = DIFFERENCE * np.eye(len(at))
        return [(self._point(at + step), self._point(at - step)) for step in steps]

    def _allow_for_jumps(self, at: Floats) -> None:
        """Widen the deviations by the jumps of the computed forces around a point with slopes.

        A tissue that breaks in or parts a little earlier changes a force at once. Such jumps, of
        the same variance at three points, have six times that variance as a second difference.
        """
        for bag, without in enumerate(self._without_jumps):
            middle = self._known[bag, self._point(at)]
            second = [
                self._known[bag, up] + self._known[bag, down] - 2.0 * middle
                for i, (up, down) in enumerate(self._ends(at))
                if (bag, i) not in self._untouched
            ]
            times = self._observations[bag].times
            squares = [np.mean(window_means(times, each) ** 2, axis=1) / 6.0 for each in second]
            squares = [each for each in squares if not np.isnan(each).any()] or [np.zeros(1)]
            jumps = uniform_filter1d(np.mean(squares, axis=0), _JUMP_WINDOWS, mode='nearest')
            self._deviations[bag] = np.sqrt(without**2 + jumps[:, None])

    def _weighted(self, bag: int, forces: Floats) -> Floats:
        """Return window means over their deviations, shape (3 windows,); 0 where none is known."""
        return self._divided(bag, window_means(self._observations[bag].times, forces))

    def _divided(self, bag: int, means: Floats) -> Floats:
        return np.nan_to_num(means / self._deviations[bag], nan=0.0).ravel()

    def _point(self, at: Floats) -> Point:
        return tuple(float(f'{value:.6g}') for value in np.exp(at))

    def _need(self, wanted: Iterable[tuple[int, Point]]) -> None:
        missing = [each for each in dict.fromkeys(wanted) if each not in self._known]
        if missing:
            self._known |= self._compute(missing)


def _loss(residuals: Floats) -> float:
    """Return the loss `soft_l1` of residuals."""
    return 2.0 * float(np.sum(np.hypot(1.0, residuals) - 1.0))
