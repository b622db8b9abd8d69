"""Vectors in kernels against numpy."""

import numpy as np
import pytest

from visdom_plugin.compute import lanes
from visdom_plugin.compute.kernels import kernel

DTYPES = (np.float32, np.float64)


@kernel()
def _calculate(x, y, out, number):
    a, b = lanes.load(x, 3), lanes.load(y, 0)
    some = (a < b) & (a >= number)
    lanes.store(out, 0, lanes.where(some, a * b + number, number - a / b))
    lanes.store(out, 16, lanes.minimum(a, number) - lanes.maximum(b, number))
    lanes.store(out, 32, lanes.count_up(number) * lanes.fill(number))
    lanes.store(out, 48, lanes.exp2(a * b))
    lanes.store(out, 64, lanes.totals((a, b, a * b)))
    out[80] = lanes.any_of(a > number)


def draw(dtype):
    generator = np.random.default_rng(5)
    return generator.uniform(-3, 3, 40).astype(dtype), generator.uniform(1, 3, 16).astype(dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_equals_numpy(dtype):
    x, y = draw(dtype)
    a, b, number, out = x[3:19], y, dtype(0.25), np.full(81, np.nan, dtype)
    _calculate(x, y, out, number)
    tolerance = {
        "rtol": 3e-7 if dtype == np.float32 else 1e-13,
        "atol": 1e-6 if dtype == np.float32 else 1e-13,
    }
    some = (a < b) & (a >= number)
    np.testing.assert_allclose(out[:16], np.where(some, a * b + number, number - a / b), **tolerance)
    np.testing.assert_allclose(out[16:32], np.minimum(a, number) - np.maximum(b, number), **tolerance)
    np.testing.assert_array_equal(out[32:48], (number + np.arange(16)) * number)
    np.testing.assert_allclose(
        out[48:64], np.exp2((a * b).astype(np.float64)), rtol=2e-6 if dtype == np.float32 else 1e-13
    )
    np.testing.assert_allclose(out[64:67], [a.sum(), b.sum(), (a * b).sum()], rtol=1e-6, atol=1e-5)
    assert not out[67:80].any() and out[80] == 1


def test_a_product_that_is_not_there_is_refused():
    @kernel()
    def mixed(x, y, out):
        lanes.store(out, 0, lanes.load(x, 0) * lanes.load(y, 0))

    x, y = np.ones(16, np.float32), np.ones(16, np.float64)
    with pytest.raises(Exception, match="No implementation"):
        mixed(x, y, x)
