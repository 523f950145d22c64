"""A hand's force is cut along the axes at their limit alone, and torques within the limits are left as they are."""

import numpy as np
import pytest

from rumi.sim.hand_limits import HandDynamics

LIMITS = np.array((25.0, 25.0, 15.0, 4.0))
AXES = [0, 1, 2, 5]


@pytest.fixture
def arm() -> tuple[np.ndarray, np.ndarray]:
    """Mass matrix and Jacobian of an arm that is nowhere near singular."""
    random = np.random.default_rng(0)
    root = random.standard_normal((7, 7))
    return 0.02 * root @ root.T + 0.05 * np.eye(7), random.standard_normal((6, 7))


def test_what_is_within_the_limits_stays(arm):
    mass, jacobian = arm
    small = np.linalg.solve(mass, jacobian[AXES].T @ (0.5 * LIMITS))
    np.testing.assert_allclose(HandDynamics.of(mass, jacobian).pressed(small, LIMITS), small, atol=1e-12)


def test_a_hand_that_is_asked_for_more_presses_with_no_more(arm):
    mass, jacobian = arm
    # a force on the hand alone, and torques that make it press along no axis
    null = np.linalg.svd(jacobian[AXES])[2][-1]
    acceleration = np.linalg.solve(mass, jacobian[AXES].T @ (80.0, -10.0, -40.0, 1.0)) + null
    torque = mass @ (HandDynamics.of(mass, jacobian).pressed(acceleration, LIMITS) - null)
    force = np.linalg.lstsq(jacobian[AXES].T, torque, rcond=None)[0]
    np.testing.assert_allclose(jacobian[AXES].T @ force, torque, rtol=1e-6, atol=0.1)
    assert (np.abs(force) < 1.05 * LIMITS).all()


def test_an_axis_at_its_limit_leaves_the_others_their_own_pull():
    # what moves along z moves along x too: to keep straight along x takes a force along z, which a held hand is spared
    jacobian = np.eye(6, 7)
    jacobian[0, 2] = 0.5
    hand = HandDynamics.of(np.eye(7), jacobian)
    along = np.array((500.0, 0.0, 2.0, 0.0))
    cut = hand.pressed(np.linalg.pinv(hand.axes) @ along, LIMITS)
    force = np.linalg.lstsq(hand.across, cut, rcond=None)[0]
    assert force[0] == pytest.approx(LIMITS[0], rel=0.05)
    assert 0.0 < force[2] < 2.0
    np.testing.assert_allclose(force[[1, 3]], 0.0, atol=0.05)


def test_a_singular_posture_keeps_it_finite(arm):
    mass, jacobian = arm
    jacobian[2] = 0.0
    cut = HandDynamics.of(mass, jacobian).pressed(np.full(7, 100.0), LIMITS)
    assert np.isfinite(cut).all() and np.abs(cut).max() < 1e4
