"""The arm on one host, the tissue on another, and a bad network between: safe, and it completes."""

from itertools import pairwise

import pytest
from live import (
    MEASURED_CF,
    PROFILE,
    SPOT,
    TISSUE_FORCE,
    Recording,
    free_domain,
    phase,
    require_limits,
    write_scene,
)

from bench.graph.impaired_link import missing_rights
from bench.graph.two_hosts import (
    INTERRUPTED_IMPAIRMENT,
    INTERRUPTION_S,
    Ended,
    ages,
    checked_meshes,
    last_status,
    run_on_two_hosts,
)

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.thorough,
    pytest.mark.skipif(bool(missing_rights()), reason=missing_rights()),
]
SECONDS = 12.0


def palpate_and_cut() -> list[object]:
    x, y = SPOT
    end = (0.014, 0.004, 0.0075)
    return [
        phase('approach', (x, y, 0.0190, 1.0), share=1.0),
        phase('palpate', (x, y, 0.0115, 1.0), (x, y, 0.0115, 1.0), (x, y, 0.0190, 1.0), share=3.0),
        phase('cut', (x, 0.004, 0.0060, 1.0), (x, 0.004, 0.0075, 0.5), (*end, 4.0), share=5.5),
        phase('retract', (*end[:2], 0.040, 1.0), share=1.0),
        phase('rest', share=1.5),
    ]


@pytest.fixture(scope='module')
def ended(tmp_path_factory: pytest.TempPathFactory) -> Ended:
    folder = tmp_path_factory.mktemp('hosts')
    scene = write_scene(folder, palpate_and_cut(), SECONDS, 0.2, 'combined')
    return run_on_two_hosts(scene, folder, INTERRUPTED_IMPAIRMENT, free_domain(), INTERRUPTION_S)


@pytest.fixture(scope='module')
def recording(ended: Ended) -> Recording:
    print(ended.bridge_said, ended.sim_said)
    return Recording(ended.bag)


def test_the_session_completes_and_cuts(ended: Ended, recording: Recording) -> None:
    assert recording.complete
    assert 'died' not in ended.bridge_said + ended.sim_said
    assert 'did not finish' not in ended.bridge_said
    assert 'nothing was cut' not in ended.bridge_said
    assert ended.sim_status == 0


def test_the_link_was_as_bad_as_it_was_asked_to_be(recording: Recording) -> None:
    assert ages(recording.bag, TISSUE_FORCE).min() > INTERRUPTED_IMPAIRMENT.delay
    frames = [m.log_time * 1e-9 for m in recording.messages('/tissue/frame_inputs')]
    assert max(b - a for a, b in pairwise(frames)) > INTERRUPTION_S[1] - 0.5


def test_every_force_is_safe_and_it_fades_while_the_link_is_away(recording: Recording) -> None:
    require_limits(recording)
    _, felt = recording.force(MEASURED_CF)
    assert felt.max() <= PROFILE.max_force
    assert felt.max() > 0.05
    status = last_status(recording.bag, 'haptic_bridge')
    assert int(status['stale_trips']) >= 1
    assert status['fault'] == ''


def test_both_sides_end_with_the_same_mesh(recording: Recording) -> None:
    checked = checked_meshes(recording.bag)
    assert checked
    assert all(same for _, same in checked)
    assert last_status(recording.bag, 'haptic_bridge')['mesh_mismatches'] == '0'
    updates = recording.messages('/tissue/mesh_updates')
    assert recording.bag.read(updates[-1]).topology > 0
