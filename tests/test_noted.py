"""Tables of a solve that its derivatives take over."""

import drjit as dr
import numpy as np
import pytest

import atmo_jit
from atmo_jit import noted
from atmo_jit.backend import evaluated, floats, table_of, traversing, types

EARTH = atmo_jit.Atmosphere.load("earth")


def derivatives(sky, known):
    """By all coefficients, of a weighted sum of the moments of all orders; kernels run."""
    band = sky.solutions[0]
    values = band.optics.values(sky.resolution.degrees, sky.resolution.phase_degree)
    leaves = [type(v)(v) for name in ("scattering", "extinction") for of_kind in values[name] for v in of_kind]
    dr.enable_grad(leaves)
    kinds, channels = len(values["scattering"]), len(values["solar"])
    rows = [leaves[i * channels : (i + 1) * channels] for i in range(2 * kinds)]
    values |= {"scattering": rows[:kinds], "extinction": rows[kinds:]}
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), traversing():
        dr.kernel_history_clear()
        done = sky.orders_again([values], [band.field.shares], [band.columns.table], known)[0]
        lights = [done["first"], *done["later"]]
        for light in lights:
            dr.set_grad(light, floats(np.cos(np.arange(dr.width(light)))))
        dr.enqueue(dr.ADMode.Backward, *lights)
        dr.traverse(dr.ADMode.Backward)
        found = np.concatenate([dr.grad(leaf).numpy() for leaf in leaves])
        kernels = len(dr.kernel_history([dr.KernelType.JIT]))
    return found, [light.numpy() for light in lights], kernels


def test_derivatives_of_known_orders():
    """They are those of orders that are solved once more, which takes as many kernels again."""
    sky = atmo_jit.Sky(EARTH, sure=True)
    again, lights, kernels = derivatives(sky, None)
    found, same, fewer = derivatives(sky, [sky.solutions[0].field.known])
    assert found == pytest.approx(again, rel=1e-4, abs=1e-5 * float(np.abs(again).max()))
    for got, want in zip(same, lights, strict=True):
        assert got == pytest.approx(want, rel=1e-5, abs=1e-6 * float(np.abs(want).max()))
    assert fewer < 0.75 * kernels


def test_only_solves_for_derivatives_are_noted():
    assert atmo_jit.Sky(EARTH).solutions[0].field.known is None


def doubled(number):
    """2 x as a table of rows, and 3 x: each evaluated."""
    lane = dr.arange(types().UInt, 4)
    return table_of([number + 0.0 * types().Float(lane), number * 2.0], lane), evaluated(number * 3.0)


@pytest.mark.parametrize("forward", [False, True])
def test_derivatives_pass_known_tables(forward):
    """Forward and backward, through numbers that are those noted."""
    with noted.noting() as tables:
        doubled(types().Float(1.0))
    number = types().Float(1.0)
    dr.enable_grad(number)
    with noted.knowing(tables):
        rows, tripled = doubled(number)
    assert rows.numpy().tolist() == [1.0, 2.0] * 4
    if forward:
        dr.set_grad(number, 1.0)
        dr.enqueue(dr.ADMode.Forward, number)
        dr.traverse(dr.ADMode.Forward)
        assert dr.grad(rows).numpy().tolist() == [1.0, 2.0] * 4
        assert dr.grad(tripled).numpy().tolist() == [3.0]
    else:
        dr.backward(dr.sum(rows) + tripled)
        assert dr.grad(number).numpy().tolist() == [4.0 * 3.0 + 3.0]


def test_tables_that_are_left_over_are_an_error():
    with noted.noting() as tables:
        doubled(types().Float(1.0))
    with pytest.raises(AssertionError, match="1 tables"), noted.knowing(tables):
        evaluated(types().Float(1.0))
