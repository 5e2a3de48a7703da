"""A hand taken off the tool and put to it again, over DDS, and computed again from the bag."""

from pathlib import Path

import numpy as np
import pytest
from live import (
    ABOVE,
    CONTACT,
    PRESSED,
    SERVO_CF,
    SPOT,
    LiveSession,
    Recording,
    free_domain,
    phase,
    require_limits,
    write_scene,
)
from ruamel.yaml import YAML

from cutting_trainer.bags.comparison import compare
from cutting_trainer.bags.reader import open_bag
from cutting_trainer.bags.recorded_indexings import recorded_indexings
from cutting_trainer.haptic_bridge.force_kernels import TOUCHING
from cutting_trainer.node_common.cdr_codec import ContactCodec
from cutting_trainer.recordings.recorded_scene import restore_scene
from cutting_trainer.recordings.resimulate_command import pose_check, recomputation
from cutting_trainer.recordings.what_if import recorded_run, run_experiment
from cutting_trainer.session.scene_loader import load_scene

pytestmark = pytest.mark.live

SECONDS = 9.0
ASIDE = (0.006, 0.004)


def clutched_hand(folder: Path) -> Path:
    """The block, pressed; the hand goes up and aside without the tool, and presses on there."""
    up = PRESSED + 0.02
    away = phase('retract', (*ASIDE, up, 1.0), share=1.5)
    phases = [
        phase('approach', (*SPOT, ABOVE, 1.0), share=1.0),
        phase('palpate', (*SPOT, PRESSED, 0.6), (*SPOT, PRESSED, 1.4), share=2.0),
        {**away, 'button': True, 'name': 'without the tool'},
        phase('palpate', (*ASIDE, up, 1.0), (*ASIDE, up - 0.001, 0.3), (*ASIDE, up - 0.001, 1.0)),
        phase('retract', (*ASIDE, up + 0.02, 1.0), share=1.3),
    ]
    phases[3]['share'] = 2.5
    path = write_scene(folder, phases, SECONDS, cut_threshold=100.0)
    scene = YAML(typ='safe').load(path)
    scene.setdefault('device', {})['clutch_button'] = 0
    with path.open('w') as file:
        YAML().dump(scene, file)
    return path


def test_the_tool_stays_without_force_and_all_is_the_same_again(tmp_path: Path) -> None:
    session = LiveSession(tmp_path, clutched_hand(tmp_path), free_domain())
    try:
        assert not session.complaints()
    finally:
        session.clean()
    recording, bag = Recording(session.bag), open_bag(session.bag)
    first, pressed, released = recorded_indexings(bag)
    assert [first.clutched, pressed.clutched, released.clutched] == [False, True, False]
    since, until = recording.at(pressed.after_ns), recording.at(released.after_ns)
    assert until - since > 1.0
    times, tips, states = recording.read(CONTACT, ContactCodec(), 'device', 'state')
    held = (times > since) & (times <= until)
    assert np.ptp(tips[held], axis=0).max() < 1e-12
    assert (states[held] == TOUCHING).all()
    # The tool does not jump: from one pose to the next it never goes faster than the hand can.
    # A contact without a stamp is from before the first pose.
    assert np.abs(np.diff(tips[times > recording.at(0)], axis=0)).max() < 1e-3
    at, norms = recording.force(SERVO_CF)
    assert not norms[(at > since + 0.05) & (at < until)].any()
    after = norms[(at > until + 2.0) & (at < until + 2.4)]
    before = norms[(at > since - 0.3) & (at < since)]
    assert after.min() > before.max() > 0.05  # a millimetre deeper
    require_limits(recording)

    scene = load_scene(str(restore_scene(bag, tmp_path)))
    result = compare(bag, recomputation(scene), pose_check(scene))
    assert result.identical, result
    assert not result.missing
    # The same hand in a computed session presses as hard, at the same places.
    was, differs = recorded_run(bag, recomputation(scene))
    assert differs is None
    now = run_experiment(bag, scene, recomputation(scene, changed=True))
    assert now.forces.max() == pytest.approx(was.forces.max(), rel=0.05)
    assert now.contact.sum() == pytest.approx(was.contact.sum(), rel=0.05)
