"""Each function of NumPy, with its arguments, beside NumPy itself. x is (batch, 6), y (batch, 3, 2), b a condition, i integers, z complex.

Expressions are separated by | or the end of a line, and ¦ stands for the operator |. Each is a factor of a program.
"""

from functools import cache

import numpy as np
import onnxruntime
import pytest

from helpers.long_tests import long_case
from helpers.phi_programs import (
    benign_programs,
    execute_program,
    random_inputs,
    read_program,
    recorded_programs,
    varied_programs,
)
from helpers.toy_envs import phi_source
from lare_rl.phi.evaluate import evaluate
from lare_rl.phi.limits import RefusedError
from lare_rl.phi.numpy_functions.registry import FUNCTIONS
from lare_rl.phi.onnx import onnx_model
from lare_rl.phi.read import read

SETUP = """import numpy as np
import math

def weigh(z):
    z = np.asarray(z)
    z = (z.astype(float) if z.dtype == bool else z).reshape(len(z), -1)
    return np.sum(z * np.arange(1, z.shape[1] + 1), axis=1, keepdims=True)

def evaluation_func(observation, action):
    x, a = observation, action
    y = x.reshape(-1, 3, 2)
    b, i = x > 0.2, np.floor(np.abs(x) * 3).astype(int)
    n = np.where(x > 1, np.nan, x)
    t = np.array([0.5, 1.5, -2.0, 4.0])
    z = x + 1j * x[:, ::-1]
    return [{}]
"""
EXPRESSIONS = {
    "elementwise": """
        np.sqrt(np.abs(x)) | np.exp(x) | np.log(np.abs(x) + 1) | np.log1p(np.abs(x)) | np.expm1(x) | np.exp2(x) | np.log2(x * x + 1)
        np.log10(x * x + 1) | np.cbrt(x) | np.sin(x) | np.cos(x) | np.tan(x) | np.arcsin(np.tanh(x)) | np.arccos(np.tanh(x)) | np.arctan(x)
        np.sinh(x) | np.cosh(x) | np.tanh(x) | np.arcsinh(x) | np.arccosh(1 + x * x) | np.arctanh(np.tanh(x)) | np.abs(x) | np.absolute(x)
        np.fabs(x) | np.negative(x) | np.sign(x) | np.floor(x) | np.ceil(x) | np.trunc(x) | np.rint(x) | np.fix(x) | np.square(x)
        np.reciprocal(x + 9) | np.positive(x) | np.degrees(x) | np.deg2rad(x) | np.isnan(n) | np.isinf(x) | np.isfinite(n) | np.signbit(x)
        np.isposinf(x) | np.maximum(x, 0) | np.minimum(x, a[:, :1]) | np.fmax(n, 0.1) | np.fmin(n, 1) | np.add(x, 1)
        np.subtract(x, a[:, :1]) | np.multiply(x, x) | np.divide(x, 3) | np.true_divide(1, x + 9) | np.power(x, 2)
        np.power(np.abs(x), 1.7) | np.power(i, 3) | np.float_power(i, 2) | x ** 0.5 * 0 + 1 | np.abs(x) ** 0.5 | x ** 3 | x ** 4 | 2.0 ** x
        np.mod(x, 0.7) | np.remainder(i, 4) | np.fmod(x, 0.7) | np.fmod(i - 3, 2) | np.floor_divide(x, 0.7) | i // 2 | i % 3 | -i // 2
        np.divmod(i, 3)[0] | divmod(x, 0.6)[1] | np.modf(x)[0] | np.arctan2(x, a[:, :1]) | np.hypot(x, 2) | np.logaddexp(x, 0)
        np.logaddexp2(x, 1) | np.copysign(x, a[:, :1]) | np.heaviside(x, 0.5) | np.sinc(x) | np.ldexp(x, 2) | np.clip(x, -1, 0.5)
        np.clip(x, None, 0.5) | x.clip(min=0) | np.clip(x, a_min=-1, a_max=a[:, :1]) | np.nan_to_num(n) | np.nan_to_num(n, nan=7.0)
        np.round(x, 1) | np.around(x) | x.round(2) | round(2.567, 1) * x | np.isclose(x, a[:, :1], atol=0.3) | np.where(b, x, -x)
        np.less(x, 0) | np.greater_equal(x, a[:, :1]) | np.not_equal(i, 2) | x == x | np.logical_and(b, x < 1) | np.logical_not(b) | ~b
        b & (x < 1) | b ¦ (x < -1) | b ^ (x < 1) | i & 1 | i ¦ 4 | i ^ 3 | ~i | i << 2 | i >> 1 | np.bitwise_and(i, 5) | np.invert(b)
        b * x | b + b | ~np.fmax(b, x < -1) | ~np.fmin(b, x < 1) | b * 1 | -(b * 1) | np.sum(b, axis=1) | b.mean(axis=1)
        np.select([x > 1, x > 0], [x, 2 * x], default=-1) | np.piecewise(x, [x < 0, x >= 0], [lambda v: -v, 3.0])
        np.choose(i % 3, [x, x * 2, -x]) | np.unwrap(x * 4, axis=1) | x.real | np.abs(x + 1j * a[:, :1]) | np.angle(np.exp(1j * x))
        (np.exp(1j * x).mean(axis=1) * 2).imag | np.conj(x) | np.real(x)
        np.ascontiguousarray(x[:, :2]) | np.asfortranarray(x) | np.vectorize(lambda v: v * 2)(x)
        np.multiply(x, 2, out=np.zeros_like(x)) | np.divide(x, a[:, :1], out=np.zeros_like(x), where=b) | np.add(b, x < 1, dtype=int)
        (lambda v: [np.nan_to_num(v, copy=False, nan=7.0), v][1])(n * 1.0) | np.reciprocal(i + 2) | np.reciprocal(-1 - i)
        np.fabs(b) + np.fabs(b) | np.fabs(i) / 2 | np.logaddexp.reduce(np.where(b, x, -np.inf), axis=1) | np.log1p(np.abs(x) * 1e-6) * 1e6
        np.expm1(x * 1e-6) * 1e6 | np.hypot(x * 1e18, 1e18) / 1e18 | np.round(x, 1) // 0.1 | np.round(x, 1) % 0.1 < 0.05
        np.signbit(x * 0) | np.copysign(1.0, x * 0) | np.arctan2(x * 0, -np.abs(x)) | np.log1p(np.abs(x) * 1e38)
        np.arctan2(x / 0, a[:, :1] / 0)
        -1 // (np.abs(x) / 0 + 1) | np.arctan2(0.0, x * 0) | np.arctan2(x * 0, x * 0)
        np.piecewise(i, [i < 2], [0.5, 1.7]) | b ** 2 + b ** 2 | np.square(b) + np.square(b)
        np.isnan(b) | np.isinf(i) | np.isclose(i, i[:, ::-1])
    """,
    "reductions": """
        np.nan_to_num(np.max(n, axis=1)) | np.nan_to_num(n.min(axis=1), nan=9.0) | np.argmax(n, axis=1) | np.argmin(n, axis=1)
        np.sum(x, axis=1) | x.sum(-1) | y.sum(axis=(1, 2)) | np.sum(y, axis=2, keepdims=True) | np.sum(x, axis=1, where=b)
        np.sum(x, axis=1, initial=2.0) | np.prod(x, axis=1) | np.max(x, axis=1) | x.max(axis=-1, keepdims=True) | np.amin(y, axis=1)
        np.max(x, axis=1, where=b, initial=-9) | np.any(b, axis=1) | b.all(axis=1) | np.argmax(x, axis=1) | y.argmin(axis=2) | x.mean(1)
        np.argmax(x, axis=1, keepdims=True) | np.mean(y, axis=(1, 2)) | np.mean(x, axis=1, where=x < 5) | np.average(x, axis=1)
        np.average(x, axis=1, weights=np.arange(6) + 1) | np.average(x, axis=1, weights=np.abs(x) + 1) | np.std(x, axis=1)
        y.var(axis=1, ddof=1) | np.ptp(x, axis=1) | np.count_nonzero(b, axis=1) | np.nansum(n, axis=1) | np.nanmean(n, axis=1)
        np.nanmax(n, axis=1) | np.nanmin(n, axis=1) | np.nanstd(n, axis=1) | np.nanprod(n, axis=1) | np.nanargmax(n, axis=1)
        np.cumsum(x, axis=1) | x.cumprod(axis=1) | np.nancumsum(n, axis=1) | np.maximum.accumulate(x, axis=1)
        np.minimum.accumulate(y, axis=1) | np.add.accumulate(x, axis=1) | np.add.reduce(x, axis=1) | np.maximum.reduce(x, axis=1)
        np.logaddexp.reduce(x, axis=1) | np.multiply.reduce(x, 1) | ~np.fmax.accumulate(b, axis=1) | ~np.fmin.accumulate(b, axis=1)
        np.logical_or.reduce(b, axis=1) | np.maximum.reduce([x[:, 0], x[:, 1], x[:, 2]]) | np.diff(x, axis=1) | np.diff(x, n=2)
        np.diff(y, axis=1) | np.diff(x, axis=1, prepend=0) | np.diff(x, axis=1, append=x[:, -1:]) | np.gradient(x, axis=1)
        np.gradient(x, 0.1, axis=1) | np.gradient(x, np.array([0, 1, 3, 4, 6, 7.0]), axis=1)
        np.gradient(x, np.array([0, 1, 3, 4, 6, 7.0]), axis=1, edge_order=2) | np.gradient(x, axis=1, edge_order=2)
        np.trapezoid(x, axis=1) | np.trapezoid(x, np.arange(6) ** 2, axis=1) | np.trapezoid(x, dx=0.1) | np.sort(x, axis=1)
        np.argsort(x, axis=1) | np.sort(y, axis=1) | [s.sort(axis=1, kind="stable") or s for s in [x.copy()]][0]
        [s.partition(2) or s[:, 2] for s in [x.copy()]][0] | np.partition(x, 2, axis=1)[:, 2] | np.lexsort((x, i)) | np.median(x, axis=1)
        np.median(y, axis=(1, 2)) | np.percentile(x, 30, axis=1) | np.quantile(x, 0.25, axis=1, keepdims=True)
        np.quantile(x, [0.25, 0.5], axis=1).T | np.percentile(x, 25, axis=1, method="nearest")
        np.percentile(x, 25, axis=1, method="higher") | np.percentile(x, 25, axis=1, method="midpoint") | np.linalg.norm(x, axis=1)
        np.linalg.norm(y, axis=2, keepdims=True) | np.linalg.norm(x, ord=1, axis=1) | np.linalg.norm(x, 3, 1)
        np.linalg.norm(x, np.inf, axis=1) | np.linalg.norm(x, ord=0, axis=1) | np.linalg.norm(y, axis=(1, 2))
        np.linalg.norm(y, 1, axis=(1, 2)) | np.average(np.arange(6).reshape(2, 3), axis=1, weights=[1, 2, 3])[0] * x
        np.gradient(y, axis=(2, 1))[0] | np.gradient(y, 2.0, 3.0, axis=(2, 1))[1] | np.minimum(np.var(t, ddof=9), 5) * x
    """,
    "shapes": """
        x.reshape(-1, 2, 3) | x.reshape(len(x), 6) | x.reshape(len(x), 2, -1) | x.reshape((x.shape[0], -1, 3)) | y.transpose(0, 2, 1)
        y.swapaxes(1, 2) | np.swapaxes(y, -1, -2) | np.moveaxis(y, 1, 2) | np.moveaxis(y, 2, 1) | np.rollaxis(y, 2, 1) | y.mT | x.T.T
        np.transpose(y, (0, 2, 1)) | np.expand_dims(x, 1) | x[:, None, :] | np.squeeze(x[:, :1]) | np.squeeze(y[:, :1], axis=1)
        np.atleast_2d(x) | np.atleast_3d(x) | np.concatenate([x, a], axis=1) | np.concatenate((y, y), axis=-1)
        np.stack([x, 2 * x], axis=1) | np.stack([x[:, 0], x[:, 1]], axis=-1) | np.vstack([x[:, 0], x[:, 1]]).T | np.hstack([x, a])
        np.column_stack([x[:, 0], a]) | np.dstack([x, x]) | np.append(x, a, axis=1) | np.c_[x[:, 0], x[:, 1:3]] | np.c_[y, y]
        np.block([x, a]) | np.split(x, 3, axis=1)[1] | np.split(x, [1, 4], axis=1)[1] | np.array_split(x, 4, axis=1)[0]
        np.hsplit(x, 2)[1] | np.unstack(x, axis=1)[2] | np.delete(x, 1, axis=1) | np.delete(x, [0, 2], axis=1)
        np.insert(x, 2, 0.5, axis=1) | np.insert(x, -1, 0.5, axis=1) | np.insert(x, 6, 0.5, axis=1) | np.flip(x, axis=1) | np.fliplr(x)
        x[:, ::-1] | np.rot90(y, axes=(1, 2)) | np.roll(x, 2, axis=1) | np.roll(y, (1, 1), axis=(1, 2)) | np.repeat(x, 2, axis=1)
        np.repeat(x, [1, 2, 0, 1, 1, 1], axis=1) | x.repeat(3, axis=1) | np.tile(x, (1, 2)) | np.tile(t, (len(x), 1))
        np.broadcast_to(t, (len(x), 4)) | np.broadcast_arrays(x[:, :1], t)[1] + x[:, :1] | np.pad(x, ((0, 0), (1, 2)))
        np.pad(x, ((0, 0), (2, 0)), mode="edge") | np.pad(x, ((0, 0), (1, 1)), constant_values=3) | np.take(x, [0, 3], axis=1)
        x.take(2, axis=1) | np.take(t, i % 4) | t[i % 4] | np.take_along_axis(x, np.argsort(x, axis=1), axis=1)
        x[np.arange(len(x)), np.argmax(x, axis=1)] | y[np.arange(len(x)), i[:, 0] % 3, 1] | y[np.arange(len(x))[:, None], i[:, :2] % 3, 0]
        np.diagonal(y[:, :2], axis1=1, axis2=2) | np.trace(y[:, :2], axis1=1, axis2=2)
        np.lib.stride_tricks.sliding_window_view(x, 3, axis=1) | x[:, [0, 2, 4]] | x[:, -2:] | x[..., 1] | x[:, 1:5:2] | y[:, 1, :]
        y[..., [1, 0]] | x[:, np.array([True, False] * 3)] | x[:, slice(1, 3)] | np.zeros_like(x) + x
        np.full((len(x), 2), 3.0) * x[:, :2] | np.ones(len(x)) * x[:, 0] | x.reshape(len(x) * 3, 2).sum(axis=1).reshape(len(x), 3)
        x.reshape(-1, 2)[:, 0].reshape(-1, 3) | np.repeat(x, 2, axis=0).reshape(len(x), -1)
        np.apply_along_axis(lambda v: np.convolve(v, [1, 2, 1], "valid"), 1, x) | np.apply_along_axis(np.sum, 1, x)
        x.flatten().reshape(x.shape) | y.reshape(-1, 6, order="F") | np.reshape(t, (2, 2), order="F")[0, 1] * x
        np.linalg.diagonal(np.arange(12).reshape(3, 2, 2))[2] * x[:, :2] | np.linalg.trace(np.arange(8).reshape(2, 2, 2))[1] * x
        np.delete(np.eye(2), 1)[2] * x | np.insert(np.eye(2), 1, 9)[1] * x | np.pad([1, 2], 1, constant_values=0.5)[0] * x + x
        (lambda m: [np.fill_diagonal(m, 2), m][1])(np.zeros((3, 3, 3)))[1, 1, 1] * x
        (lambda m: [np.fill_diagonal(m.T, 2), m][1])(np.zeros((2, 2)))[1, 1] * x
        (lambda m: [np.putmask(m, m > 1, 7), m][1])(x * 1) | (lambda m: [np.place(m, m > 1, [7]), m][1])(x * 1)
        np.block([[x, a]]) | np.repeat(x, 2).reshape(x.shape[0], 12) | np.insert(x, 2, a[:, 0], axis=1)
    """,
    "products": """
        x @ np.ones(6) | x @ np.arange(12).reshape(6, 2) | y @ y.transpose(0, 2, 1) | np.matmul(y, np.ones((2, 4)))
        np.dot(x, np.arange(6)) | np.einsum("bi,bi->b", x, x) | np.einsum("bij,bkj->bik", y, y) | np.einsum("...i,i->...", x, np.arange(6))
        np.einsum("bij->bj", y) | np.einsum("bi,ij,bj->b", x, np.eye(6), x) | np.inner(x, np.arange(6))
        np.tensordot(y, np.ones((3, 2)), axes=2) | np.vecdot(x, x) | np.tensordot(y, np.ones((2, 4)), axes=1)
        np.cross(x[:, :3], x[:, 3:]) | np.cross(x[:, :3], [0, 0, 1]) | np.outer(t, t)[0, 1] * x | np.linalg.det(y[:, :2])
        np.linalg.inv(y[:, :2] + 4 * np.eye(2)) | np.linalg.solve(y[:, :2] + 4 * np.eye(2), x[:, :2, None])
        np.linalg.slogdet(y[:, :2])[1] | np.linalg.matrix_power(y[:, :2], 3) | np.linalg.eigvalsh(y[:, :2] + y[:, :2].transpose(0, 2, 1))
        np.linalg.eigvalsh(np.einsum("bi,bj->bij", x[:, :3], x[:, :3]) + np.eye(3)) | np.linalg.multi_dot([x, np.eye(6), np.ones((6, 2))])
        np.kron(np.eye(2), np.ones((1, 3)))[0] * x | np.convolve(t, [1, 1])[:3] * x[:, :3] | np.correlate(t, [1, 2.0])[0] * x
        np.vdot(t, t) * x | np.linalg.pinv(np.ones((2, 3)))[0, 0] * x | np.abs(np.fft.rfft(x, axis=1)) | np.fft.fft(x, axis=1).real
        np.fft.rfftfreq(6) * x[:, :4] | np.abs(np.subtract.outer(t, t)).sum() * x | np.linalg.cholesky(np.eye(6) * 4)[0] * x
        np.correlate([1, 2.0], t, "valid")[1] * x | np.correlate([1, 2.0], [1, 2, 3, 4, 7], "same")[0] * x
        np.linalg.vector_norm(np.eye(3), ord=1) * x | np.linalg.vector_norm(y, axis=(1, 2))
        x[:, :, None] * x[:, None, :] | b @ np.ones(6, dtype=bool) | np.einsum("bi,bi->b", b, x < 1, dtype=int)
    """,
    "less usual": """
        np.permute_dims(y, (0, 2, 1)) | np.matrix_transpose(y) | np.vsplit(np.eye(6), 2)[1][0] * x | np.dsplit(y, 2)[1]
        np.flipud(np.eye(6))[0] * x | np.broadcast_shapes((1, 3), (2, 1))[1] * x | np.resize(t, (2, 3))[1, 0] * x
        np.diagflat([1, 2])[1, 1] * x | np.corrcoef(np.eye(3))[0, 1] * x | np.eye(3)[np.diag_indices(3)].sum() * x | np.hamming(6) * x
        np.blackman(6) * x | np.bartlett(6) * x | np.kaiser(6, 2.0) * x | np.i0(t)[0] * x | np.argwhere(t > 0)[1, 0] * x
        np.union1d([1], [2]).sum() * x | np.intersect1d([1, 2], [2])[0] * x | np.setdiff1d([1, 2], [2])[0] * x
        np.setxor1d([1, 2], [2, 3]).sum() * x | np.gcd(12, 18) * x | np.lcm(4, 6) * x | np.allclose(t, t + 1e-9) * x | np.less_equal(x, 0)
        np.triu_indices_from(np.eye(3))[1].sum() * x | np.tril_indices_from(np.eye(3), -1)[0].sum() * x | np.bitwise_or(i, 2)
        np.bitwise_xor(i, 2) | np.left_shift(i, 1) | np.right_shift(i, 1) | np.conjugate(x) | np.bitwise_not(i) | np.bitwise_invert(i)
        np.isneginf(x) | np.nanargmin(n, axis=1) | np.nanvar(n, axis=1) | np.ediff1d(t)[0] * x | np.linalg.vector_norm(x, axis=1)
        np.matvec(np.ones((2, 6)), x) | np.vecmat(x, np.ones((6, 2))) | np.linalg.matrix_rank(np.eye(3)) * x
        np.linalg.svd(np.eye(3))[1][0] * x | np.linalg.svdvals(np.eye(3))[0] * x | np.polyint([2, 1])[0] * x
        np.polynomial.legendre.legval(x, [1, 0.5, 0.2]) | np.polynomial.hermite.hermval(x, [1, 0.5])
        np.polynomial.hermite_e.hermeval(x, [1, 0.5, 0.1]) | np.polynomial.laguerre.lagval(x, [1, 0.5]) | np.polyadd([1, 2], [3])[1] * x
        np.polysub([1, 2], [3])[1] * x | np.polymul([1, 2], [3])[1] * x | np.polydiv([1, 3, 2], [1, 1])[0][1] * x
        np.polynomial.polynomial.polyint([1, 2])[2] * x | np.polynomial.polynomial.polymul([1, 2], [3, 1])[1] * x
        np.polynomial.polynomial.polyadd([1, 2], [3])[0] * x | np.copyto(x.copy(), 1.0) or x | np.fft.ifft(x, axis=1).real
        np.fft.ifft(np.fft.fft(x, axis=1), axis=1).real | np.abs(np.fft.rfft(x, n=4, axis=1))
        np.fft.ifft(np.fft.fft(x, n=5, axis=1), n=8, axis=1).real
    """,
    "complex": """
        (x / z).imag | (1 / z).imag | (z - 1j).imag | (-z * z).imag | np.square(z).imag | np.exp(z).imag | np.conj(z).imag | (z ** 8).imag
        (z ** 2.0).imag | np.power(z, 5.0).imag | (z / (1e-200 + 1e-200j)).real * 1e-200 | np.where(b, z, 1).imag
        np.where(b, 1j * x, np.inf).imag | np.imag(z) | np.real(z) | np.imag(x) | np.angle(z) | np.angle(x) | np.angle(np.conj(x))
        np.angle(x * (1 + 0j)) | np.angle(np.array([x[:, :1], 1j * x[:, :1]])[0]) | np.angle(np.fft.rfft(x, axis=1))
        np.angle(np.fft.rfft(x, n=5, axis=1)) | np.angle(np.fft.rfft(y, axis=1)) | np.angle(np.fft.rfft(-np.abs(x), axis=1))
        np.fft.fft(z, n=4, axis=1).imag | np.fft.ifft(z, axis=1).imag | z.sum(axis=1).imag | np.sum(z, axis=1, where=b).imag
        np.sum(z, axis=1, initial=5.0).imag | np.sum(z, axis=1, initial=5j).imag | np.mean(z, axis=1, where=b ¦ (x < 9)).imag
        np.cumsum(z, axis=1).imag | np.diff(z, axis=1, prepend=1).imag | np.diff(z, 1, 1, x[:, :1]).imag
        np.diff(z, axis=1, append=z[:, :1]).imag | z.reshape(-1, 3, 2).imag | np.reshape(z, (len(x), 3, 2)).imag
        np.ravel(z).reshape(z.shape).imag | z.flatten().imag.reshape(-1, 6) | z.T.T.imag | np.transpose(z).T.imag
        np.swapaxes(z[:, :, None], 2, 1).imag | np.moveaxis(z[:, :, None], 2, 1).imag | np.take(z, indices=np.array([0, 2]), axis=1).imag
        np.concatenate([x, z], axis=1).imag | np.stack([x, z], axis=1).imag | np.roll(z, 1, axis=1).imag | np.flip(z, axis=1).imag
        np.expand_dims(z, 1).imag | np.squeeze(z[:, :1]).imag | np.copy(z).imag | np.broadcast_to(z[:, :1], (len(x), 6)).imag
        np.repeat(z, repeats=np.array([1, 2, 1, 1, 1, 1]), axis=1).imag | np.tile(z, (1, 2)).imag
        np.split(z, indices_or_sections=np.array([2, 4]), axis=1)[1].imag | np.hsplit(z, 2)[1].imag | np.array_split(z, 4, axis=1)[1].imag
        np.asarray(z).imag | np.hstack([x, z]).imag | np.column_stack([x, z]).imag | np.vstack([1j * t, [1, 2, 3, 4]]).imag.sum() * x
        np.atleast_1d(z).imag | np.atleast_2d(z).imag | np.array([1j, 2.5, True]).imag.sum() * x
        np.array([[1j, 2], [3, 4j]]).imag.sum() * x | np.mean([1j, 2, 3]).imag * x | np.concatenate([[1j], [2.0]]).imag.sum() * x
        np.exp([1j, 2j]).imag.sum() * x | np.abs([1j, 2]).sum() * x
    """,
    "tables": """
        np.interp(x, [-1, 0, 2], [0.0, 1.0, -1.0]) | np.interp(x, [0, 1], [3, 4.0], left=-1, right=9)
        np.interp(x[:, 0], t.cumsum()[:2], [1, 2]) | np.interp(x, [0.2, 0.4], [1.0, 2.0], period=1.0) | np.searchsorted([-1, 0, 1], x)
        np.searchsorted(np.array([-1, 0, 1]), x, side="right") | np.digitize(x, [-1, 0, 1]) | np.digitize(x, [-1, 0, 1], right=True)
        np.digitize(x, [1, 0, -1]) | np.polyval([1, -2, 0.5], x) | np.polynomial.polynomial.polyval(x, [1, -2, 0.5])
        np.poly1d([1, 0, 2])(x) | np.poly1d([1, 0, 2]).coef[0] * x | np.polynomial.Polynomial([1, 0, 2]).coef[0] * x
        np.poly1d([1, 4, 2]).deriv(2).c[0] * x | np.polynomial.Polynomial([1, 0, 2])(x) | np.polynomial.chebyshev.chebval(x, [1, 0.5, 0.2])
        np.polyval(np.polyder([1, 2, 3]), x) | np.isin(i, [1, 3]) | np.isin(i, [1, 3], invert=True) | np.unravel_index(i % 6, (2, 3))[1]
        np.ravel_multi_index((i[:, :1] % 2, i[:, 1:2] % 3), (2, 3)) | np.eye(4)[i % 4] | np.tril(np.ones((6, 6)))[2] * x
        np.triu(y[:, :2]) | np.tri(3)[1] * x[:, :3] | np.diag([1, 2, 3.0]) @ x[:, :3, None] | np.diag(np.ones(2), 1).sum() * x
        np.identity(3)[0] * x[:, :3] | np.linspace(0, 1, 6) * x | np.arange(0, 3, 0.5) * x | np.logspace(0, 1, 6) * x
        np.geomspace(1, 8, 6) * x | np.linspace(-2, 1, 6, dtype=int) * x | np.logspace(0, 1, 6, base=2) * x
        np.meshgrid(t, t)[0].sum() * x | np.mgrid[0:2, 0:3].sum() * x | np.mgrid[-1:1:-5j][3] * x | np.ogrid[0:6] * x
        np.r_[1, 2, 0:4] * x | np.ix_([0, 1], [1])[0].sum() * x | np.indices((2, 2)).sum() * x | np.eye(6)[np.ix_(t > 0, [0])].sum() * x
        np.arange(9).reshape(3, 3)[np.meshgrid([0, 2], [1, 2])].sum() * x | np.fromiter((k * k for k in range(4)), float, 3)[-1] * x
        np.tril_indices(3)[0].sum() * x | np.hanning(6) * x | np.vander([1, 2, 3]).sum() * x | np.unique([3, 1, 3]).sum() * x
        np.nonzero(t > 0)[0].sum() * x | np.histogram(t, bins=2)[0].sum() * x | np.bincount([1, 1, 3])[1] * x
        np.roots([1, -3, 2]).sum() * x | np.polyfit([0, 1, 2], [0, 1, 2], 1)[0] * x
        np.fromfunction(lambda r, c: r + c, (2, 3)).ravel() * x | np.trim_zeros([0, 1, 2, 0])[0] * x | np.cov(t) * x
        np.polynomial.polynomial.polyval(t, np.arange(4).reshape(2, 2))[1, 2] * x | np.isin(i, [1, 3], True)
        np.array_equal(t, t) * x | np.fill_diagonal(np.eye(2), 3) or x | np.finfo(float).eps * x | np.finfo(np.float32).max * 0 * x
        np.arange(6).reshape(2, 3).item(4) * x | np.arange(6).reshape(2, 3).T.item(1, 0) * x | hasattr(z, "foo") * x
        t[np.nan_to_num(i) % 4] | (lambda c: [np.nan_to_num(c).fill(5), c][1])(np.arange(6)) * x
        np.fromiter([1, 2, 3], int, 2).sum() * x | (lambda c: [np.array(c, copy=False).fill(5), c][1])(np.zeros(6)) * x
        (lambda c: [np.array(c).fill(5), c][1])(np.ones(6)) * x
        np.pi * x | len(type(x).__name__) * x | (0, 1, 0).index(0, 1) * x | np.array([[1, 2], [3, 4]])[1, 0] * x
    """,
}
CASES = {}
for group, text in EXPRESSIONS.items():
    expressions = [expression.strip().replace("¦", "|") for expression in text.strip().replace("\n", "|").split("|")]
    CASES |= {f"{group} {start}": expressions[start : start + 16] for start in range(0, len(expressions), 16)}
PROGRAMS = {p.name: p for p in (*benign_programs(), *varied_programs(), *recorded_programs())}
IN_SHORT = {p.name for p in (*varied_programs()[::20], *recorded_programs()[::120])}


@cache
def read_case(name):
    source = SETUP.format(", ".join(f"weigh({expression})" for expression in CASES[name]))
    return source, read(source, 6, 3)


@pytest.mark.filterwarnings("ignore:Degrees of freedom <= 0")
@pytest.mark.parametrize("name", CASES)
def test_function_agrees_with_numpy(name):
    source, graph = read_case(name)
    observation, action = random_inputs((6, 3), rows=9)
    result = evaluate(graph, {"observation": observation, "action": action}, dtype=np.float64)["factors"]
    expected = execute_program(source, observation, action)
    for expression, column, expected_column in zip(CASES[name], result.T, expected.T, strict=True):
        np.testing.assert_allclose(column, expected_column, rtol=1e-9, atol=1e-9, err_msg=expression)


def test_every_function_is_tried():
    """Each registered name, or another name of the same function, is in an expression above or in a program of the corpus."""
    text = "\n".join([*EXPRESSIONS.values(), *(program.source for program in PROGRAMS.values())])
    names_by_function = {}
    for name, function in FUNCTIONS.items():
        names_by_function.setdefault(function, []).append(name.rpartition(".")[2])
    assert [names for names in names_by_function.values() if not any(name in text for name in names)] == []


def check_onnx(graph, sizes):
    model = onnx_model(graph, "phi").SerializeToString()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    inputs = dict(zip(("observation", "action"), random_inputs(sizes, rows=7, dtype=np.float32), strict=True))
    (factors,) = session.run(["factors"], inputs)
    np.testing.assert_allclose(factors, evaluate(graph, inputs)["factors"], rtol=2e-3, atol=2e-4)


def test_onnx_model_of_integers_that_are_too_large():
    columns = ("x / 0", "x / 0 - x / 0", "x * 1e20")
    factors = ", ".join(f"({column}).astype(int)[:, :1] * 1.0" for column in columns)
    check_onnx(read(phi_source(f"x = observation\nreturn [{factors}]"), 6, 3), (6, 3))


@pytest.mark.parametrize("name", CASES)
def test_onnx_model_of_functions(name):
    check_onnx(read_case(name)[1], (6, 3))


@pytest.mark.parametrize("name", [name if name in IN_SHORT else long_case(name) for name in PROGRAMS])
def test_onnx_model_of_a_program(name):
    program = PROGRAMS[name]
    try:
        graph = read_program(program)
    except RefusedError:
        pytest.skip("it is refused")
    check_onnx(graph, program.sizes)
