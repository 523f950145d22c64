"""Isolation of a contact by joint torques: whether it can be at the hand (Haddadin, De Luca, Albu-Schaeffer 2017)."""

import numpy as np

_UNFELT = 1e-4  # damping of a wrench by torques: where an arm is stretched out, some forces make none


def unexplained_by_hand(external: np.ndarray, jacobian: np.ndarray, hand_m: float) -> float:
    """Norm of what a force through the hand leaves of external joint torques, N m.

    The force is that of the wrench on the hand that would best make them, its moment about the tool frame cut to what a
    force through the hand can have; moments about the force itself, as of friction, are let be.

    Args:
        external: (J,), torques.
        jacobian: (6, J), of the tool frame.
        hand_m: from the tool frame to where the hand is farthest from it.
    """
    wrench = np.linalg.solve(jacobian @ jacobian.T + _UNFELT * np.eye(6), jacobian @ external)
    force, moment = wrench[:3], wrench[3:]
    size = max(float(np.linalg.norm(force)), 1e-9)
    about = (moment @ force) / size**2 * force
    across = moment - about
    share = min(1.0, hand_m * size / max(float(np.linalg.norm(across)), 1e-9))
    return float(np.linalg.norm(external - jacobian.T @ np.concatenate((force, about + share * across))))
