"""Attention and layers in plain NumPy."""

import math

import numpy as np


def numpy_attention(query, key, value, mask):
    """Return attention of shape (queries, heads * size); the inputs are (tokens, heads, size), the mask (queries, tokens)."""
    output = np.zeros_like(query)
    for i, head in np.ndindex(query.shape[:2]):
        tokens = mask[i]
        scores = key[tokens, head] @ query[i, head] / np.sqrt(query.shape[-1])
        output[i, head] = np.exp(scores) / np.exp(scores).sum() @ value[tokens, head]
    return output.reshape(len(query), -1)


def numpy_linear(layer, x):
    return x @ np.asarray(layer.weight) + np.asarray(layer.bias)


def numpy_layer_norm(rows, epsilon):
    return (rows - rows.mean(axis=1, keepdims=True)) / np.sqrt(rows.var(axis=1, keepdims=True) + epsilon)


def numpy_gelu(x):
    return x * 0.5 * (1 + np.vectorize(math.erf)(x / np.sqrt(2)))


def numpy_mlp(mlp, x, activation=lambda x: np.maximum(x, 0)):
    """Return the output of some layers with an activation between them."""
    for layer in mlp.layers[:-1]:
        x = activation(numpy_linear(layer, x))
    return numpy_linear(mlp.layers[-1], x)


def numpy_time_layer(layer, x):
    """Return the output of a layer of STAS over the steps of an agent, (steps, size).

    Its input is not added again after the feed-forward layers, and the attention is added twice.
    """
    heads = (numpy_linear(linear, x).reshape(len(x), 4, -1) for linear in (layer.query, layer.key, layer.value))
    a = numpy_linear(layer.merge, numpy_attention(*heads, np.tri(len(x), dtype=bool)))
    hidden = numpy_mlp(layer.feed_forward, numpy_layer_norm(x + a, 1e-12), numpy_gelu)
    return numpy_layer_norm(hidden + 2 * a, 1e-12)


def numpy_coalitions(layer, x, masks):
    """Return the mean over coalitions of attention over agents, (agents, size). Each agent has its own queries."""
    query = np.stack([x[i] @ layer.query.weight[i] + layer.query.bias[i] for i in range(len(x))])
    heads = [v.reshape(len(x), 4, -1) for v in (query, numpy_linear(layer.key, x), numpy_linear(layer.value, x))]
    return np.mean([numpy_linear(layer.merge, numpy_attention(*heads, mask)) for mask in masks], axis=0)
