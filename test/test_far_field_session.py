"""The bench of a far field compares node by node, through a cut."""

import numpy as np
import pytest

from bench.accuracy import far_field_session
from bench.accuracy.far_field_session import DRAWN, PALPATED, PHASES, FarFieldSession
from cutting_trainer.tissue_sim.motion.active_region import ActiveSettings

pytestmark = pytest.mark.long


def test_the_same_session_has_no_error_and_a_far_field_has_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(far_field_session.BRICKS, 4_536, (14, 9, 6))
    session = FarFieldSession(4_536, 1, (0.05, 0.05), 'linear')
    exact = session.run(ActiveSettings())
    assert exact.elements_cut > 0
    assert np.ptp([len(shape) for shape in exact.shapes]) > 0
    again = session.run(ActiveSettings(), exact)
    for phase in PHASES.values():
        errors = session.errors(again, exact, phase)
        assert np.nan_to_num(errors).max() == 0.0
    some = session.run(ActiveSettings('budget', 60), exact)
    assert 1e-5 < session.errors(some, exact, PALPATED).compliance < 0.1
    assert 1e-5 < session.errors(some, exact, DRAWN).force < 0.1
