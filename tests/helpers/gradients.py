"""Gradients with respect to many parameters at once."""

import contextlib

import drjit as dr


@contextlib.contextmanager
def gradients_enabled(mi, params, keys, n):
    """
    Of several parameters, to be read in one kernel: numbers and colours are repeated for each of ``n`` lanes, since the
    gradient of a single number is a sum over all lanes, which is a kernel for each.
    """
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    given = {key: dr.detach(params[key]) for key in keys}
    for key, value in given.items():
        if not dr.is_tensor_v(value):
            params[key] = value + dr.opaque(mi.Float, 0, n)
            dr.enable_grad(params[key])
    yield
    for key, value in given.items():
        params[key] = value
    params.update()
