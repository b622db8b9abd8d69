"""Vectors in kernels against numpy."""

import numpy as np
import pytest

from visdom_plugin.compute import lane_math, lanes
from visdom_plugin.compute.kernels import kernel

DTYPES = (np.float32, np.float64)


@kernel()
def _calculate(x, y, out, number):
    a, b = lanes.load(x, 3), lanes.load(y, 0)
    some = (a < b) & (a >= number)
    lanes.store(out, 0, lanes.where(some, a * b + number, number - a / b))
    lanes.store(out, 16, lanes.minimum(a, number) - lanes.maximum(b, number))
    lanes.store(out, 32, lanes.count_up(number) * lanes.fill(number))
    lanes.store(out, 48, lane_math.exp2(a * b))
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


@kernel()
def _round(x, out):
    v = lanes.load(x, 0)
    lanes.store(out, 0, lanes.floor(v) + 2 * lanes.ceil(v))
    lanes.store(out, 16, lanes.sqrt(lane_math.exp(v)))
    lanes.store(out, 32, lane_math.log2(lanes.maximum(v, v * v)))
    lanes.store(out, 48, lane_math.exp(v * 1000))
    lanes.store(out, 64, 1 / (v - 0.1))


@pytest.mark.parametrize("dtype", DTYPES)
def test_functions_of_vectors_equal_numpy(dtype):
    x, _ = draw(dtype)
    out, v = np.full(80, np.nan, dtype), x[:16]
    _round(x, out)
    tolerance = 5e-7 if dtype == np.float32 else 1e-14
    exact = v.astype(np.float64)
    np.testing.assert_array_equal(out[:16], np.floor(v) + 2 * np.ceil(v))
    np.testing.assert_allclose(out[16:32], np.exp(exact / 2), rtol=tolerance)
    np.testing.assert_allclose(
        out[32:48], np.log2(np.maximum(exact, exact**2)), rtol=tolerance, atol=tolerance
    )
    assert np.isfinite(out[48:64]).all() and (out[48:64][v > 0.1] > 1e37).all()
    assert (out[48:64][v < -0.1] < 1e-37).all()
    np.testing.assert_array_equal(out[64:], dtype(1) / (v - dtype(0.1)))  # a number is rounded first


def test_multiply_add_rounds_once():
    @kernel()
    def multiply(x, out):
        v = lanes.load(x, 0)
        lanes.store(out, 0, lanes.multiply_add(v, v, lanes.fill(x[16])))

    x, out = np.full(17, 1 + 2**-12, np.float32), np.empty(16, np.float32)
    x[16] = -(1 + 2**-11)
    multiply(x, out)
    assert (out == 2**-24).all()  # rounded twice it were 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_numbers_apart_are_read_and_written(dtype):
    @kernel()
    def move(x, out, whole, square):
        v = lanes.take(x, 1, 3)
        lanes.put(out, 2, 2, v)
        lanes.put(whole, 0, 1, v)
        lanes.store_all(square, 0, (v, v + 1))

    x = np.arange(60, dtype=dtype)
    out, whole, square = np.zeros(40, dtype), np.zeros(16, np.int32), np.zeros((2, 16), dtype)
    move(x, out, whole, square)
    np.testing.assert_array_equal(out[2:34:2], x[1:49:3])
    assert not out[1::2].any() and not out[34:].any()
    np.testing.assert_array_equal(whole, x[1:49:3])
    np.testing.assert_array_equal(square, [x[1:49:3], x[1:49:3] + 1])


@pytest.mark.parametrize("dtype", DTYPES)
def test_rows_become_columns(dtype):
    @kernel()
    def turn(x, out):
        lanes.transpose(x, 5, 20, out, 0, 18)

    x, out = np.random.default_rng(0).random((20, 20)).astype(dtype), np.zeros((16, 18), dtype)
    turn(x, out)
    np.testing.assert_array_equal(out[:, :16], x.reshape(-1)[5:325].reshape(16, 20)[:, :16].T)
    assert not out[:, 16:].any()


def test_a_product_that_is_not_there_is_refused():
    @kernel()
    def mixed(x, y, out):
        lanes.store(out, 0, lanes.load(x, 0) * lanes.load(y, 0))

    x, y = np.ones(16, np.float32), np.ones(16, np.float64)
    with pytest.raises(Exception, match="No implementation"):
        mixed(x, y, x)
