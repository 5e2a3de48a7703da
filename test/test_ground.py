"""Claims about the surface that the proxy moves on: it has no dent of the tool."""

from flat_tissue import POSITIONS, TRIANGLES

from cutting_trainer.haptic_bridge.proxy.surface import Surface
from cutting_trainer.haptic_bridge.proxy.undented_surface import UndentedSurface

MS = 1_000_000


def lowered(depth, revision, previous=None, topology=1):
    """The flat tissue, let down as a whole [m]."""
    return Surface(
        POSITIONS - [0, 0, depth],
        TRIANGLES,
        revision=revision,
        topology=topology,
        previous=previous,
    )


def pressed():
    """A ground under a tool, and the dented surface."""
    ground, first = UndentedSurface(), lowered(0.0, 1)
    ground.follow(0, first)
    ground.freeze()
    dent = lowered(3e-3, 2, first)
    ground.follow(33 * MS, dent)
    return ground, first, dent


def test_a_free_tool_follows_the_tissue():
    ground, first = UndentedSurface(), lowered(0.0, 1)
    ground.follow(0, first)
    moved = lowered(3e-3, 2, first)
    ground.follow(33 * MS, moved)
    assert ground.surface is moved
    assert ground.blend(33 * MS) == 0.0
    assert ground.blend(99 * MS) == 1.0


def test_the_dent_of_the_tool_is_not_followed():
    ground, first, dent = pressed()
    assert ground.surface is first
    assert ground.newest is dent
    assert ground.blend(33 * MS) == 1.0


def test_a_change_of_connectivity_is_followed_at_once():
    ground, _, _ = pressed()
    cut = lowered(3e-3, 3, topology=2)
    ground.follow(66 * MS, cut)
    assert ground.surface is cut


def test_a_simulation_that_starts_again_is_followed_at_once():
    ground, _, _ = pressed()
    again = lowered(0.0, 0)
    ground.follow(66 * MS, again)
    assert ground.surface is again


def test_after_contact_it_waits_until_the_tissue_has_recovered():
    ground, first, dent = pressed()
    for k in range(5):  # nobody has said yet that the tool was let go
        ground.follow((66 + k) * MS, dent)
    assert ground.surface is first
    ground.note_free(80 * MS, 3)
    ground.follow(81 * MS, dent)
    back = lowered(1e-3, 3, dent)
    ground.follow(99 * MS, back)
    assert ground.surface is first  # 2 mm of motion in that frame
    still = lowered(1e-3 - 5e-5, 4, back)
    ground.follow(132 * MS, still)
    assert ground.surface is still


def test_a_tissue_that_never_rests_is_followed_after_half_a_second():
    ground, first, dent = pressed()
    ground.note_free(50 * MS, 2)
    surface = dent
    for k in range(3, 30):
        surface = lowered(3e-3 * ((k + 1) % 2), k, surface)
        ground.follow(33 * k * MS, surface)
        assert (ground.surface is first) == (33 * k <= 550)
