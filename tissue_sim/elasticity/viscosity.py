"""Viscosity by a Prony series: stresses that shear has relaxed from, by node.

The elastic model has the instantaneous moduli. Of the deviatoric stress T of a node's smoothing
domain, in the frame that turns with it, each term follows with its relaxation time, and its share
is taken from the elastic stress:

    s_i' = (T - s_i) / tau_i,    P = P_elastic - R sum of g_i s_i

Volume stays elastic. The s_i are constant for some substeps, in which they are a nodal load; then
they follow the present T. For a linear law no motion whatever gains energy from that: with
a = 1 - exp(-dt / tau), summation by parts of the work leaves - (1 / a - 1 / 2) |change of s|^2.
"""

from typing import Any, NamedTuple

import numpy as np

from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.elasticity.nodal_smoothing import NodalSmoothing, SmoothingDomains
from cutting_trainer.tissue_sim.elasticity.viscous_stress import (
    KEPT,
    LAW,
    LINEAR,
    TURNING,
    relieve,
)
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TopologyDelta, Touched, carried_over, grown


class ViscousNodes(NamedTuple):
    """State by node.

    Attributes:
        terms: KEPT numbers for each term, shape (n, KEPT k).
        relief: stress that the load stands for, by rows [Pa], shape (n, 9).
        since: simulated time of the last change [s], shape (n,).
        energy: what the terms add to the elastic energy, negative or positive [J], shape (n,).
        rotation: quaternions, shape (n, 4).
    """

    terms: np.ndarray
    relief: np.ndarray
    since: np.ndarray
    energy: np.ndarray
    rotation: np.ndarray


class Viscosity:
    """Viscous state of a mesh under cuts.

    Args:
        model: the elastic model, whose material has a Prony series.
    """

    def __init__(self, model: ElasticModel) -> None:
        self._model, m, n = model, model.material, model.mesh.node_count
        self._series = np.array(m.prony)
        self._law = np.array([m.lame_mu, 0.0, m.lame_lambda, m.stiffening])
        self._kind = LAW if model.lawful else TURNING if model.rotating else LINEAR
        self._own = None
        if model.smoothing is None or len(model.mesh.regions):
            # One state by node: where regions meet, that of their mean strain by stiffness. What
            # relaxes is then never more than the elements store.
            constants = m.lame_lambda, m.lame_mu, m.relative_stiffness
            self._own = NodalSmoothing(model.mesh, *constants, split=False)
        terms = np.zeros((n, KEPT * len(self._series)))
        self.nodes = ViscousNodes(
            terms, np.zeros((n, 9)), np.zeros(n), np.zeros(n), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        )
        self._time = 0.0
        self._left = np.inf
        self.lost = 0.0

    @property
    def shortest(self) -> float:
        """Shortest relaxation time [s]."""
        return float(self._series[:, 1].min())

    @property
    def settled(self) -> bool:
        """Whether nothing is left to relax, but for rounding."""
        return self._left < 1e-9 * self._law[0]

    @property
    def energy(self) -> float:
        """Energy that the terms add to the elastic one [J]: what is stored is the sum."""
        return float(self.nodes.energy[: self._model.mesh.node_count].sum())

    def advance(self, u: np.ndarray, seconds: float, spans: np.ndarray, load: np.ndarray) -> None:
        """Let the terms of some nodes follow their stress.

        Those of other nodes, whose strain does not change, follow once they are among them.

        Args:
            u: displacement by coordinate at the end [m], shape (3 n,).
            seconds: simulated time since the last call [s].
            spans: intervals of nodes, shape (s, 2).
            load: of the model, changed [N], shape (3 n,).
        """
        self._time += seconds
        lost, self._left = self._relieve(u, self._time, spans, load)
        self.lost += lost

    def relax(self, u: np.ndarray, load: np.ndarray) -> None:
        """Relax all stresses in full, as after a long time in this shape.

        Arguments: see `advance`.
        """
        self._relieve(u, np.inf, self._everywhere, load)
        self.nodes.since[:] = self._time
        self._left = 0.0

    def reload(self, u: np.ndarray, load: np.ndarray) -> None:
        """Add the whole relief to a load without it; no time passes.

        Arguments: see `advance`.
        """
        self.nodes.relief[:] = 0.0
        self._relieve(u, self._time, self._everywhere, load)

    def apply_cut(self, count: int, delta: TopologyDelta, touched: Touched) -> None:
        """Carry the state through a change of connectivity; `reload` must follow.

        Args:
            count: of nodes before it.
            delta: the change, which mesh and model have followed.
            touched: the written slots.
        """
        if self._own is not None:
            self._own.update(touched.nodes)
        total = count + len(delta.node_parents)
        self.nodes = ViscousNodes(*(grown(values, total) for values in self.nodes))
        carried_over(self.nodes.terms, count, delta, touched)
        flat = self.nodes.since[:, None]
        carried_over(flat, count, delta, touched)
        self.nodes.rotation[count:] = self.nodes.rotation[touched.nodes] = (1.0, 0.0, 0.0, 0.0)
        self._left = np.inf

    def kept(self) -> tuple[Any, ...]:
        """Return a copy of the state without the load, for `restore`."""
        copies = tuple(values.copy() for values in self.nodes)
        return ViscousNodes(*copies), self._time, self._left, self.lost

    def restore(self, kept: tuple[Any, ...]) -> None:
        """Return to a state of `kept`; its load must follow."""
        nodes, self._time, self._left, self.lost = kept
        self.nodes = ViscousNodes(*(values.copy() for values in nodes))

    @property
    def domains(self) -> SmoothingDomains:
        """Return the smoothing domains whose strain counts."""
        smoothing = self._own or self._model.smoothing
        assert smoothing is not None
        return smoothing.operands

    @property
    def _everywhere(self) -> np.ndarray:
        return np.array([[0, self._model.mesh.node_count]])

    def _relieve(
        self, u: np.ndarray, now: float, spans: np.ndarray, load: np.ndarray
    ) -> tuple[float, float]:
        lost, left = relieve(
            self.domains, self.nodes, spans, u, now, self._series, self._law, self._kind, load
        )
        return float(lost), float(left)
