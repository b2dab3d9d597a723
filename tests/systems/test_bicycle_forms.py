"""A short form of the benchmark of the bicycle on groups."""

import numpy as np

from benchmarks.bicycle_forms import forms


def test_all_forms_have_the_same_energies_and_no_wheel_slips():
    values = []
    for system, q, v in forms().values():
        for constraint in (
            system.constraint(0.0, q, v),
            system.holonomic(0.0, q, None),
        ):
            np.testing.assert_allclose(constraint, 0, atol=1e-12)
        rolling, resting = (
            system.lagrangian(0.0, q, scale * v, None) for scale in (1, 0)
        )
        values.append([rolling, resting])
    np.testing.assert_allclose(values[1:], values[:1] * 2, rtol=1e-13)
