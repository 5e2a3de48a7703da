"""Claims about what `bench speed` prints: sound figures of every benchmark, at any size."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from meshes import box as block

from bench.speed import command as bench
from bench.speed.flow import session
from bench.speed.frame import frame
from bench.speed.parts import Part
from bench.speed.proxy import proxy
from bench.speed.scaling import line, measure
from bench.speed.tissue import box, moved_bytes
from cutting_trainer.session.errors import SessionError
from cutting_trainer.tissue_sim.elasticity.material import Material
from cutting_trainer.tissue_sim.elasticity.models import ElasticModel
from cutting_trainer.tissue_sim.mesh.tetra_mesh import TetMesh

pytestmark = pytest.mark.long


@pytest.fixture(scope='module', autouse=True)
def _short() -> None:
    bench.BENCHES = bench.BENCHES | {
        Part.FRAME: (lambda sizes: frame(sizes, frames=40), [300]),
        Part.PROXY: (lambda: proxy(repeats=1, ticks=50), []),
        Part.SESSION: (lambda sizes: session(sizes, seconds=0.2), [300]),
        Part.START: (lambda: bench.start(repeats=1), []),
    }


@pytest.mark.parametrize(
    'name',
    [
        pytest.param(name, marks=pytest.mark.thorough) if name in (Part.START, Part.FORCE) else name
        for name in Part
    ],
)
def test_each_benchmark_gives_sound_figures_as_json(
    name: Part, capsys: pytest.CaptureFixture[str]
) -> None:
    sizes = [] if name in (Part.PROXY, Part.START) else [300]
    bench.run_bench([name], sizes, as_json=True, save=False)
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert list(report['figures']) == ['memory', name.value]
    rows = [row for rows in report['figures'].values() for row in rows]
    assert len({row['name'] for row in rows}) == len(rows)
    for row in rows:
        assert 0 <= row['low'] <= row['median'] <= row['high'] < math.inf
        assert (row['ratio'] is None) == (row['against'] == '')


def test_a_size_for_a_benchmark_that_has_none_is_refused() -> None:
    with pytest.raises(SessionError, match='has no size'):
        bench.run_bench([Part.START], [300], as_json=True, save=False)


def test_an_earlier_run_stands_beside_a_new_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names, file = [Part.CUT], tmp_path / 'then.json'
    bench.run_bench(names, [300], as_json=True, save=False)
    then = json.loads(capsys.readouterr().out)
    row = then['figures']['cut'][0]
    row['median'], row['ratio'], row['against'] = 77.25, 12.5, 'something'
    then['machine']['processor'] = 'Abacus'
    file.write_text(json.dumps(then))
    bench.run_bench(names, [300], as_json=False, save=False, against=file)
    said = capsys.readouterr().out
    line = next(line for line in said.splitlines() if row['name'] in line)
    assert line.split()[-2:] == ['77.25', '12.50']
    assert 'median then' in said and 'processor Abacus, now' in said and then['when'] in said
    bench.run_bench(names, [300], as_json=True, save=False, against=file)
    assert json.loads(capsys.readouterr().out)['against'] == then


@pytest.mark.parametrize(
    ('words', 'wrong'), [('{"rows": []}', 'when: Field required'), ('nothing', 'Invalid JSON')]
)
def test_a_file_that_is_no_earlier_run_is_refused_before_anything_is_measured(
    words: str, wrong: str, tmp_path: Path
) -> None:
    file = tmp_path / 'rows.json'
    file.write_text(words)
    with pytest.raises(SessionError, match=f'rows.json is not of a run of bench speed: {wrong}'):
        bench.run_bench([Part.START], [], as_json=True, save=True, against=file)


def test_a_box_has_about_as_many_tetrahedra_as_it_is_asked_for() -> None:
    for size in (1000, 10_000):
        assert 0.75 * size < len(box(size).tetrahedra) < 1.25 * size


def test_the_bytes_model_counts_each_edge_once_and_each_neighbour_of_a_domain() -> None:
    nodes, tets = block((2, 2, 2), 0.01)
    mesh, n = TetMesh(nodes, tets), len(nodes)
    pairs = np.sort(np.concatenate([tets[:, [i, j]] for i in range(4) for j in range(i)]), axis=1)
    edges = len(np.unique(pairs, axis=0))
    material = Material(3000.0, 0.4, 1000.0)
    linear = moved_bytes(ElasticModel(mesh, material, 'linear'))
    assert linear == edges * (9 * 8 + 4) + n * (6 * 8 + 2 * 8 + 3 * 3 * 8)
    inside = int(((nodes > 1e-9) & (nodes < 0.02 - 1e-9)).all(axis=1).sum())
    smoothed = moved_bytes(ElasticModel(mesh, material, 'linear_smoothed'))
    assert smoothed == linear + (2 * edges + n - inside) * (3 * 8 + 4) + n * 24


def test_an_exponent_is_that_of_the_power_law() -> None:
    found = line('cost', [1000, 10_000, 100_000], [2e-3 * 10**1.5, 2e-3 * 100**1.5, 2.0 * 1e3**0.5])
    assert found.steepest == pytest.approx(1.5)
    assert line('flat', [1000, 8000], [3.0, 3.0]).exponent == pytest.approx(0.0)
    assert {entry.name for entry in measure([600, 2500])} >= {'cut batch', 'encode, all nodes'}
