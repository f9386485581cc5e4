"""Attention and layers in plain NumPy."""

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
