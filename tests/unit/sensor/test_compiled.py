"""Stages in one kernel: deviates are normal and of each pixel alone, and numpy makes the same of them."""

from __future__ import annotations

import ctypes
import math
import mmap
import sys
from typing import Any

import numpy as np
import pytest
from scipy import stats

from mitsim.core.parallel import in_threads
from mitsim.core.seeds import stream
from mitsim.sensor import chain
from mitsim.sensor.chain import by_pixel
from tests.invented import sensor

SEED = 2011
COUNT = 400_000
GATE = 1e-6


def deviates(*names: str, count: int = COUNT) -> Any:
    """(streams, count) normal deviates, one frame of pixels for each name."""
    light = np.zeros(count)
    return [by_pixel(lambda _, light, z: light + z, {}, (light,), (stream(SEED, name),)) for name in names]


def test_deviates_are_normal() -> None:
    """Kolmogorov and Smirnov's test, and the tails: 400 000 have 23 beyond 4 deviations. (Planted: 1.005 of them; a
    uniform for the radius that stops at 2^-12.)"""
    (z,) = deviates("one")
    assert stats.kstest(z, "norm").pvalue > GATE
    assert abs(z.mean()) < 5 / math.sqrt(COUNT) and abs(z.var() - 1) < 5 * math.sqrt(2 / COUNT)
    beyond = int((np.abs(z) > 4).sum())
    assert GATE < stats.poisson.cdf(beyond, COUNT * 2 * stats.norm.sf(4)) < 1 - GATE


def test_pixels_and_streams_share_no_deviates() -> None:
    """Neighbours, the four pixels of a lane, and two streams. (Planted: one key for both; one counter for a lane's
    first two pixels.)"""
    first, second = deviates("one", "other")
    lane = first.reshape(4, -1)
    pairs = [(first[1:], first[:-1]), (first, second), *((lane[0], lane[k]) for k in (1, 2, 3)), (lane[1], lane[2])]
    for one, other in pairs:
        for power in (1, 2):
            assert abs(stats.pearsonr(one**power, other**power).statistic) < 5.5 / math.sqrt(len(one))


def test_numpy_makes_the_same_frame_of_the_same_deviates() -> None:
    """Every stage, of pixels that expect many electrons; codes at a tie may be the next. (Planted: no black level; the
    full well after the linearity; read noise not in the superpixel.)"""
    pixel = {"read_noise_e": 5.0, "full_well_e": 11_000.0, "black_level_dn": 63.5, "linearity": (0.01, -0.02)}
    model = sensor(**pixel, bits=14, binning=2)
    light, count = np.linspace(300, 50_000, 10_001), 10_001
    shot, read = deviates("shot", "read", count=count)
    electrons = chain.clip_at_full_well(chain.poisson_count(light, shot), model)
    electrons = chain.bend(electrons, model) + model.superpixel_read_noise_e * read
    expected = chain.quantise(chain.amplify(electrons, model), model)
    drawn = chain.expose(light, 0.0, model, stream(SEED, "shot"), stream(SEED, "read"))
    assert drawn.dtype == np.uint32
    off = np.abs(drawn - expected)
    assert off.max() <= 1 and np.mean(off > 0) < 1e-3


def test_threads_draw_what_one_draws() -> None:
    """(Planted: the key of the stream that came last.)"""
    names = [f"frame {k}" for k in range(12)]
    together = in_threads(lambda name: deviates(name, count=1000)[0], names)
    assert np.array_equal(together, deviates(*names, count=1000))


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page of memory by Linux's calls")
def test_kernels_read_no_memory_past_an_array() -> None:
    """An array that ends where memory ends. (Planted: Dr.Jit given numpy's own memory; the process died.)"""
    system, page, count = ctypes.CDLL(None), mmap.PAGESIZE, 1004
    room = -(-8 * count // page) * page
    system.mmap.restype, size = ctypes.c_void_p, ctypes.c_size_t
    start = system.mmap(
        None, size(room + page), mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, -1, size(0)
    )
    assert system.mprotect(ctypes.c_void_p(start + room), size(page), 0) == 0
    light = np.frombuffer((ctypes.c_double * count).from_address(start + room - 8 * count))
    drawn = by_pixel(lambda _, light, z: light + z, {}, (light,), (stream(SEED, "one"),))
    assert np.array_equal(drawn, deviates("one", count=count)[0])


def test_numbers_of_a_camera_are_not_kept() -> None:
    """Another gain, after one was compiled. (Planted: numbers of the first call kept.)"""
    frames = [
        chain.expose(np.full(1000, 1e4), 0.0, sensor(gain_dn_per_e=gain), stream(1, "a"), stream(1, "b"))
        for gain in (0.5, 0.25)
    ]
    assert np.array_equal(frames[0], 2 * frames[1])
