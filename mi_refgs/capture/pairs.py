"""Which pairs of pictures to match: all of a small set; of a large one neighbours and pictures alike."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.cluster.vq import kmeans2, vq

EXHAUSTIVE = 150
"""Largest number of pictures of which every pair is matched: 11,175 pairs take some minutes."""
IN_ORDER = 8
"""In larger sets each picture is matched with this many before and after it in the order of names, which show
much of the same on a walk around an object."""
ALIKE = 20
"""In larger sets each picture is also matched with this many of the most similar ones, which close loops."""
WORDS, SAMPLES, ROUNDS = 64, 400, 12
"""Size of the vocabulary, number of features of each picture from which it is made, and iterations of
k-means."""


def pairs_to_match(features: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Pairs of the names of `features`, whose values are descriptors (N, D)."""
    names = sorted(features)
    if len(names) <= EXHAUSTIVE:
        return list(combinations(names, 2))
    near = {(i, j) for i in range(len(names)) for j in range(i + 1, min(i + 1 + IN_ORDER, len(names)))}
    likeness = similarity([features[name] for name in names])
    np.fill_diagonal(likeness, -np.inf)
    for i, best in enumerate(np.argsort(-likeness, axis=1, kind="stable")[:, :ALIKE]):
        near |= {(min(i, int(j)), max(i, int(j))) for j in best}
    return [(names[i], names[j]) for i, j in sorted(near)]


def similarity(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Cosines (N, N) of vectors that sum up the features of each picture.

    VLAD over words found by k-means in the pictures themselves, with signed square roots. [Jégou et al. 2010;
    Arandjelović and Zisserman 2013]
    """
    rng = np.random.default_rng(0)
    drawn = [rng.permutation(d)[:SAMPLES].astype(np.float32) for d in descriptors]
    everything = np.concatenate(drawn)
    if len(everything) < WORDS:
        return np.zeros((len(descriptors),) * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty word harms nothing
        words, _ = kmeans2(everything, WORDS, iter=ROUNDS, minit="points", rng=rng)
    sums = np.zeros((len(descriptors), WORDS, everything.shape[1]))
    for total, sample in zip(sums, drawn, strict=True):
        if len(sample):
            word, _ = vq(sample, words)
            np.add.at(total, word, sample - words[word])
    sums /= np.maximum(np.linalg.norm(sums, axis=2, keepdims=True), 1e-12)  # each word counts alike
    vectors = sums.reshape(len(sums), -1)
    vectors = np.sign(vectors) * np.sqrt(abs(vectors))
    vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return vectors @ vectors.T
