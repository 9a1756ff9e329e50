"""The compiled kernels of recognition against the same in NumPy."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.jit import KERNELS
from mapweave.registration.gauss_newton import stack_sightings
from mapweave.registration.projection import improve, linearise, normal_equations, of_pose_alone
from tests.hybridmap.kernel_forms import in_numpy
from tests.registration.test_projection import scene

pytest.importorskip("numba")

LEAST_SOLVED, SURE = 10, 20
"""Landmarks; a recognition needs as many. Of 200 draws with 10 to 13, one to three have no minimum near; of
those with 14 to 40 none."""


@example(158, 12)
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40))
def test_both_forms_are_the_same_to_rounding(seed: int, n: int):
    rng = np.random.default_rng(seed)
    (forward, true), (backward, _) = scene(n, rng, False), scene(max(n // 2, 1), rng, True)
    stack = stack_sightings([forward, backward], 0.01)
    near = np.append(true.vector + rng.normal(0, 0.02, 3), rng.normal())
    poses = true.vector + rng.normal(0, 0.2, (20, 3))

    def everything() -> list[np.ndarray]:
        linear = linearise(stack, near, stack.points)
        arrays = [forward.log_ratios(poses), backward.log_ratios(poses, 0.01), *linear]
        products = normal_equations(linear, near[3])
        arrays += [products, of_pose_alone(products)]
        # Fewer leave a pose that rounding decides.
        if n >= LEAST_SOLVED:
            improved = improve(stack, near, 3)
            assert improved[0] or n < SURE
            arrays += improved if improved[0] else [np.zeros(1)]
        return arrays

    compiled = everything()
    with in_numpy():
        plain = everything()
    for first, second in zip(compiled, plain, strict=True):
        scale = max(1.0, float(np.abs(first).max()))
        np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-7 * scale)


def test_nothing_is_compiled_while_a_robot_drives():
    """Every array comes in the type that the kernels are compiled for beforehand."""
    rng = np.random.default_rng(1)
    (forward, true), (backward, _) = scene(20, rng, False), scene(10, rng, True)
    part = forward.take(slice(None, None, 2))
    for sightings in (forward, backward, part):
        sightings.log_ratios(true.vector[None])
        sightings.log_ratios(np.stack([true.vector, true.vector])[::2])
    improve(stack_sightings([part, backward]), np.append(true.vector, 0.0), 2)
    counts = {
        kernel.__name__: len(kernel.machine.signatures)
        for kernel in KERNELS
        if kernel.__name__ in ("log_ratios", "linearise", "normal_equations", "determined", "improve")
    }
    assert counts == dict.fromkeys(counts, 1) and len(counts) == 5
