"""Claims about `bench.accuracy.peers`, none of which needs a peer."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest

from bench.accuracy import peers
from bench.accuracy.peer_beam import make_beam, measure, stable_step
from bench.accuracy.peer_solvers import flexcomp, neo_hookean
from bench.accuracy.problems import material
from cutting_trainer.tissue_sim.elasticity.equilibrium import equilibrium
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel, ModelName


@pytest.mark.parametrize('name', ['linear', 'corotational_smoothed'])
def test_our_beams_swing_out_to_the_deflection_of_the_charts_tissue_at_rest(
    name: ModelName,
) -> None:
    at = make_beam(0.3, 2)
    found = measure(at, peers.Own(at, name), budget=60.0)
    assert found.tetrahedra == 240 and found.cost[0] > 0.0
    assert found.real_time == pytest.approx(240e-9 * found.cost[0] / found.dt)
    still = equilibrium(ElasticModel(at.mesh, material(at.problem.solid), name), at.load)
    assert found.deflection == pytest.approx(at.deflection(still), rel=2e-3)


def test_without_time_to_come_to_rest_there_is_a_cost_and_no_deflection() -> None:
    at = make_beam(0.3, 1)
    found = measure(at, peers.Own(at, 'linear'), budget=0.0)
    assert found.deflection is None and found.cost[0] > 0.0


def test_flex_has_the_nodes_the_tetrahedra_and_the_clamps_of_the_mesh() -> None:
    at = make_beam(0.47, 2)
    body = ElementTree.fromstring(flexcomp(at, 'Euler', 1e-3)).find('.//flexcomp')
    pin = body.find('pin')
    assert np.array_equal(np.array(body.get('point').split(), float), at.mesh.rest.ravel())
    assert np.array_equal(np.array(body.get('element').split(), int), at.mesh.tetrahedra.ravel())
    assert np.array_equal(np.array(pin.get('id').split(), int), np.flatnonzero(at.mesh.fixed))
    assert float(body.get('mass')) == pytest.approx(1050.0 * 0.1 * 0.02 * 0.02)
    assert float(body.find('elasticity').get('poisson')) == 0.47


def test_a_little_strain_costs_the_neo_hookean_solids_what_it_costs_the_linear_one() -> None:
    mu, lam = 1700.0, 26_000.0
    m, k = neo_hookean(mu, lam)

    def energy(strain: np.ndarray) -> float:
        f = np.eye(3) + strain
        square = np.sum(f * f)
        swelling = np.linalg.det(f) - 1 - 3 * m / 4 / k
        return m / 2 * (square - 3 - np.log(square + 1)) + k / 2 * swelling**2

    some = np.random.default_rng(3).standard_normal((3, 3))
    strain = 1e-3 * (some + some.T)
    curved = energy(strain) + energy(-strain) - 2 * energy(np.zeros((3, 3)))
    linear = 2 * mu * np.sum(strain**2) + lam * np.trace(strain) ** 2
    assert curved == pytest.approx(linear, rel=1e-3)


def test_absent_peers_are_said_to_be_absent_and_the_others_are_measured(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peers, 'find_spec', lambda name: None if name == 'mujoco' else name)
    words = '--resolutions 1 --ratios 0.3 --budget 0 --json --only mujoco-core trainer'
    monkeypatch.setattr('sys.argv', ['peers', *words.split()])
    peers.main()
    rows = json.loads(capfd.readouterr().out)['rows']
    ours = [row for row in rows if row['package'] == 'the trainer']
    others = [row for row in rows if row not in ours]
    assert len(ours) == 5 and all(row['result']['tetrahedra'] == 30 for row in ours)
    assert len(others) == 2
    assert all(r['result'] is None and 'not installed' in r['note'] for r in others)


def test_a_peer_that_flies_apart_is_said_to_and_ends_nothing() -> None:
    class TooFast(peers.Own):
        def __init__(self, at: peers.Beam) -> None:
            super().__init__(at, 'linear')
            self.dt = 2 * stable_step(self._model, self._inverse)
            self._push *= 2

    entry = peers.Entry('too fast', 'numpy', 'numpy', TooFast, 'a force', 'no')
    row = peers.run(entry, make_beam(0.3, 1), budget=60.0)
    assert row.result is None and 'flies apart' in row.note
    assert row.package.startswith('numpy ')
