"""A thousand forged answers of the tissue: nothing in free air, little in contact."""

import pytest
from forger import SLEW, WHERE, attack

SESSIONS, FORGED = 20, 17
"""For each place, 340 forged answers: 1,020 in all."""
MAX_ABOVE = 1.2
"""[N] above stiffness x depth that is felt of any of them, of the 3 N that the device has."""


@pytest.mark.parametrize('where', WHERE)
def test_a_forged_answer_is_felt_no_more_than_the_bridge_knows_and_the_slew_allows(where):
    worst = [attack(seed, where, FORGED) for seed in range(SESSIONS)]
    assert sum(w.forged for w in worst) == SESSIONS * FORGED
    assert max(w.excess for w in worst) <= 0.0
    assert max(w.free for w in worst) == 0.0
    assert max(w.excess for w in worst) + SLEW <= MAX_ABOVE
